"""Colours of Gaussians as one camera sees them, in plain torch (kernel: ``kernels.appearance.direction``)."""

from __future__ import annotations

import torch
from torch import Tensor

from scas4d_core.engines.torch.deformation import quaternion_matrices
from scas4d_core.kernels.appearance.direction import CELLS, DARK, DULL, FALL, MIDDLE, NEARNESS, OVER, SHEEN, SIDE


def no_turns(count: int) -> Tensor:
    """[count, 4] quaternions that turn nothing."""
    turns = torch.zeros(count, 4, dtype=torch.float64)
    turns[:, 0] = 1
    return turns


def colours_seen(
    means: Tensor, turns: Tensor, colours: Tensor, gloss: Tensor | None, environment: Tensor | None, centre: Tensor
) -> Tensor:
    """[N, 3] colours as a camera at ``centre`` [3] sees them: those given where nothing is glossy.

    Args:
        gloss: [M, 3] of the first M; the others are dull. The rest are as of ``shade``.
    """
    if gloss is None or environment is None:
        return colours
    dull = torch.zeros(len(means) - len(gloss), 3, dtype=torch.float64)
    return shade(means, torch.cat([gloss, dull]), turns, colours, environment, centre)


def cell_shares() -> Tensor:
    """[CELLS] share of the sphere of each cell of the octahedral map; they sum to 1."""
    line = torch.linspace(-1, 1, SIDE, dtype=torch.float64)
    v, u = torch.meshgrid(line, line, indexing="ij")
    z = 1 - u.abs() - v.abs()
    x = torch.where(z < 0, (1 - v.abs()) * u.sign(), u)
    y = torch.where(z < 0, (1 - u.abs()) * v.sign(), v)
    area = (x * x + y * y + z * z) ** -1.5  # of the sphere behind a piece of the map
    area[[0, -1]] /= 2  # rows at the rim are half cells
    area[:, [0, -1]] /= 2
    return (area / area.sum()).flatten()


def shade(means: Tensor, gloss: Tensor, turns: Tensor, colours: Tensor, environment: Tensor, centre: Tensor) -> Tensor:
    """[N, 3] colours; arguments as the kernel's, with a gloss for every Gaussian."""
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
    """[N, 3] of a grid [CELLS, 3] over directions [N, 3] of any length, bilinear in the octahedral map."""
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
