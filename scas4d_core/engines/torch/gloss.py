"""View-dependent colours in plain PyTorch, the reference for ``kernels.appearance.direction``."""

from __future__ import annotations

import torch
from torch import Tensor

from scas4d_core.engines.torch.deformation import quaternion_matrices
from scas4d_core.kernels.appearance.direction import CELLS, DARK, DULL, FALL, MIDDLE, NEARNESS, OVER, SHEEN, SIDE


def no_turns(count: int) -> Tensor:
    """Returns [count, 4] identity quaternions."""
    turns = torch.zeros(count, 4, dtype=torch.float64)
    turns[:, 0] = 1
    return turns


def colours_seen(
    means: Tensor, turns: Tensor, colours: Tensor, gloss: Tensor | None, environment: Tensor | None, centre: Tensor
) -> Tensor:
    """Returns the colours [N, 3] as seen by a camera at ``centre`` [3], or ``colours`` if there is no gloss.

    See ``shade`` for the other arguments.

    Args:
        gloss: [M, 3] gloss of the first M Gaussians (all others are not glossy), or None if no Gaussian is glossy.
    """
    if gloss is None or environment is None:
        return colours
    dull = torch.zeros(len(means) - len(gloss), 3, dtype=torch.float64)
    return shade(means, torch.cat([gloss, dull]), turns, colours, environment, centre)


def cell_shares() -> Tensor:
    """Returns the fraction [CELLS] of the sphere covered by each cell of the octahedral map. The fractions sum to 1."""
    line = torch.linspace(-1, 1, SIDE, dtype=torch.float64)
    v, u = torch.meshgrid(line, line, indexing="ij")
    z = 1 - u.abs() - v.abs()
    x = torch.where(z < 0, (1 - v.abs()) * u.sign(), u)
    y = torch.where(z < 0, (1 - u.abs()) * v.sign(), v)
    area = (x * x + y * y + z * z) ** -1.5  # solid angle per map area
    area[[0, -1]] /= 2  # cells on the border are cut in half
    area[:, [0, -1]] /= 2
    return (area / area.sum()).flatten()


def shade(means: Tensor, gloss: Tensor, turns: Tensor, colours: Tensor, environment: Tensor, centre: Tensor) -> Tensor:
    """Returns the shaded colours [N, 3]. ``gloss`` [N, 3] must include every Gaussian.

    See ``kernels.appearance.direction.shade`` for the other arguments.
    """
    strength = gloss.norm(dim=1, keepdim=True)
    glossy = strength[:, 0] > float(DULL)
    strength = torch.where(glossy[:, None], strength, torch.ones_like(strength))
    normals = torch.einsum("nij,nj->ni", quaternion_matrices(turns), gloss / strength)
    ahead = torch.nn.functional.normalize(centre - means, dim=1)
    mu = (normals * ahead).sum(dim=1, keepdim=True)
    mirrored = 2 * mu * normals - ahead + environment[NEARNESS, 0] * (means - environment[MIDDLE])
    f = (1 - mu) ** 4
    light = colours * colours.abs() * (1 - float(FALL) * f * strength.clamp(max=1))
    light = light + strength * (looked_up(environment[:CELLS], mirrored) + environment[SHEEN] * f)
    shown = light / light.abs().clamp(min=float(DARK)).sqrt()
    shown = torch.where(shown > 1, 1 + float(OVER) * (shown - 1), shown)
    return torch.where((glossy & (mu[:, 0] > 0))[:, None], shown, colours)


def looked_up(cells: Tensor, directions: Tensor) -> Tensor:
    """Samples an octahedral map [CELLS, 3] bilinearly at directions [N, 3], which need not be normalized."""
    across = directions / directions.abs().sum(dim=1, keepdim=True)
    x, y = across[:, 0], across[:, 1]
    signs_x, signs_y = torch.where(x >= 0, 1.0, -1.0), torch.where(y >= 0, 1.0, -1.0)
    upper = across[:, 2] >= 0
    u = (torch.where(upper, x, (1 - y.abs()) * signs_x) + 1) * ((SIDE - 1) / 2)
    v = (torch.where(upper, y, (1 - x.abs()) * signs_y) + 1) * ((SIDE - 1) / 2)
    column, row = u.detach().long().clamp(0, SIDE - 2), v.detach().long().clamp(0, SIDE - 2)
    u, v, cell = (u - column)[:, None], (v - row)[:, None], row * SIDE + column
    above = (1 - u) * cells[cell] + u * cells[cell + 1]
    below = (1 - u) * cells[cell + SIDE] + u * cells[cell + SIDE + 1]
    return (1 - v) * above + v * below
