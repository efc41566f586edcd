"""View-dependent colours on the device, and optimization of gloss and environment as in ``engines.cpu.gloss``.

The formula is in ``kernels.appearance.direction``. Reference: ``engines.torch.gloss``.
"""

from __future__ import annotations

import warp as wp

from scas4d_core.engines.cpu.gloss import (
    NEIGHBOURS,
    SAME_SIDE,
    UPDATE_RATE_ENVIRONMENT,
    UPDATE_RATE_GLOSS,
    UPDATE_RATE_NEARNESS,
    cell_areas,
    environment_rates,
    gloss_rate,
)
from scas4d_core.engines.warp.adam import Optimizer, step_table
from scas4d_core.engines.warp.copies import DeviceCopies, features_on
from scas4d_core.engines.warp.layout import Camera
from scas4d_core.engines.warp.nearest import nearest
from scas4d_core.engines.warp.quaternions import change_of, conjugate
from scas4d_core.gaussians import Gaussians
from scas4d_core.kernels.appearance import direction

wp.set_module_options({"enable_backward": False})

SIDE = wp.constant(direction.SIDE)
CELLS = wp.constant(direction.CELLS)
SHEEN, MIDDLE, NEARNESS = (wp.constant(row) for row in (direction.SHEEN, direction.MIDDLE, direction.NEARNESS))
FALL, DARK, OVER, DULL = (
    wp.constant(wp.float32(value)) for value in (direction.FALL, direction.DARK, direction.OVER, direction.DULL)
)
SAME_SIDE_COSINE = wp.constant(wp.float32(SAME_SIDE))
BETAS = 0.9, 0.999
"""Adam decay rates of the gloss and environment."""
STEP = wp.constant(wp.float32((direction.SIDE - 1) / 2))


@wp.struct
class Reflection:
    """Reflection of a Gaussian towards a camera, with the environment cell that the Gaussian reflects.

    Attributes:
        valid: 0 if the Gaussian reflects no light towards the camera, otherwise 1.
        strength: gloss strength s.
        normal: normal n.
        view: direction v to the camera.
        cosine: cosine μ = n·v.
        middle: offset x − x₀ from the scene centre, in metres.
        direction: lookup direction r + k (x − x₀), not normalized.
        length: Manhattan norm of the direction.
        sign_x, sign_y: signs of the x and y components of the direction.
        cell: index of the environment cell in this direction.
        u, v: position within the cell.
        grazing: factor f = (1 − μ)⁴ of the sheen.
        left: remaining fraction of the diffuse light.
    """

    valid: wp.int32
    strength: wp.float32
    normal: wp.vec3
    view: wp.vec3
    cosine: wp.float32
    middle: wp.vec3
    direction: wp.vec3
    length: wp.float32
    sign_x: wp.float32
    sign_y: wp.float32
    cell: wp.int32
    u: wp.float32
    v: wp.float32
    grazing: wp.float32
    left: wp.float32


@wp.func
def reflection_of(
    mean: wp.vec3, gloss: wp.vec3, turn: wp.vec4, environment: wp.array2d[wp.float32], camera: Camera
) -> Reflection:
    """Returns the reflection of a Gaussian towards a camera."""
    made = Reflection()
    made.strength = wp.length(gloss)
    if made.strength > DULL:
        made.normal = (gloss + change_of(turn, gloss)) / made.strength
        centre = -(wp.transpose(camera.rotation) * camera.translation)
        made.view = wp.normalize(centre - mean)
        made.cosine = wp.dot(made.normal, made.view)
        made.middle = mean - wp.vec3(environment[MIDDLE, 0], environment[MIDDLE, 1], environment[MIDDLE, 2])
        made.direction = 2.0 * made.cosine * made.normal - made.view + environment[NEARNESS, 0] * made.middle
        p = made.direction
        made.length = wp.abs(p[0]) + wp.abs(p[1]) + wp.abs(p[2])
        if made.cosine > 0.0 and made.length > 0.0:
            made.valid = 1
            x = p[0] / made.length
            y = p[1] / made.length
            made.sign_x = wp.where(x >= 0.0, 1.0, -1.0)
            made.sign_y = wp.where(y >= 0.0, 1.0, -1.0)
            u = wp.where(p[2] >= 0.0, x, (1.0 - wp.abs(y)) * made.sign_x)
            v = wp.where(p[2] >= 0.0, y, (1.0 - wp.abs(x)) * made.sign_y)
            u = (u + 1.0) * STEP
            v = (v + 1.0) * STEP
            column = wp.clamp(wp.int32(u), 0, SIDE - 2)
            row = wp.clamp(wp.int32(v), 0, SIDE - 2)
            made.cell = row * SIDE + column
            made.u = u - wp.float32(column)
            made.v = v - wp.float32(row)
            away = 1.0 - made.cosine
            made.grazing = away * away * away * away
            made.left = 1.0 - FALL * made.grazing * wp.min(made.strength, 1.0)
    return made


@wp.func
def mirrored(environment: wp.array2d[wp.float32], at: Reflection, c: wp.int32) -> wp.float32:
    """Returns channel ``c`` of the reflected light, including the sheen."""
    top = (1.0 - at.u) * environment[at.cell, c] + at.u * environment[at.cell + 1, c]
    bottom = (1.0 - at.u) * environment[at.cell + SIDE, c] + at.u * environment[at.cell + SIDE + 1, c]
    return (1.0 - at.v) * top + at.v * bottom + environment[SHEEN, c] * at.grazing


@wp.func
def turn_of(entries: wp.array[wp.int32], turns: wp.array[wp.vec4], turned: wp.int32, i: wp.int32) -> wp.vec4:
    """Returns the rotation of Gaussian ``i``, or the identity if the Gaussian is static or ``turned`` is 0."""
    turn = wp.vec4(1.0, 0.0, 0.0, 0.0)
    if turned == 1:  # noqa: SIM102  # Warp reads both sides of an `and`
        if entries[i] >= 0:
            turn = turns[entries[i]]
    return turn


@wp.kernel
def shade(
    cameras: wp.array[Camera],
    view: wp.array[wp.int32],
    means: wp.array[wp.vec3],
    entries: wp.array[wp.int32],
    turns: wp.array[wp.vec4],
    turned: wp.int32,
    gloss: wp.array2d[wp.float32],
    environment: wp.array2d[wp.float32],
    features: wp.array[wp.vec4],
    seen: wp.array[wp.vec4],
) -> None:
    """Computes the features that a camera sees, with one thread per Gaussian.

    Args:
        cameras: [views] cameras of all views.
        view: [1] index of the view.
        means: [N] means, in metres.
        entries: [N] index of each Gaussian in ``turns``, or −1 for static Gaussians.
        turns: [M] rotations of the normals, as unit quaternions (w, x, y, z).
        turned: 1 to apply the rotations, otherwise 0.
        gloss: [G, 3] unrotated normals of the first G ≤ N Gaussians, scaled by gloss strength. All other Gaussians are
            not glossy.
        environment: [ROWS, 3] environment; see ``Gaussians``.
        features: [N] features without gloss.
        seen: [N] output, features seen by the camera.
    """
    i = wp.tid()
    out = features[i]
    if i < gloss.shape[0]:
        own = wp.vec3(gloss[i, 0], gloss[i, 1], gloss[i, 2])
        at = reflection_of(means[i], own, turn_of(entries, turns, turned, i), environment, cameras[view[0]])
        if at.valid == 1:
            for c in range(3):
                colour = features[i][c]
                light = colour * wp.abs(colour) * at.left + at.strength * mirrored(environment, at, c)
                value = light / wp.sqrt(wp.max(wp.abs(light), DARK))
                out[c] = wp.where(value <= 1.0, value, 1.0 + OVER * (value - 1.0))
    seen[i] = out


@wp.kernel
def shade_backward(
    cameras: wp.array[Camera],
    view: wp.array[wp.int32],
    means: wp.array[wp.vec3],
    entries: wp.array[wp.int32],
    turns: wp.array[wp.vec4],
    turned: wp.int32,
    gloss: wp.array2d[wp.float32],
    environment: wp.array2d[wp.float32],
    features: wp.array[wp.vec4],
    adds: wp.int32,
    g_seen: wp.array[wp.vec4],
    g_features: wp.array[wp.vec4],
    g_gloss: wp.array2d[wp.float32],
    g_environment: wp.array2d[wp.float32],
) -> None:
    """Backpropagates through ``shade``, with one thread per Gaussian.

    Args:
        cameras, view, means, entries, turns, turned, gloss, environment, features: see ``shade``.
        adds: 1 to add to ``g_features`` and ``g_gloss``, 0 to overwrite them.
        g_seen: [N] gradients of ``seen``.
        g_features: [N] output, gradients of ``features``.
        g_gloss: [G, 3] output, gradients of ``gloss``.
        g_environment: [ROWS, 3] output, gradient of the environment, accumulated. The row of x₀ is not written.
    """
    i = wp.tid()
    g_out = g_seen[i]
    g_own = wp.vec3(0.0, 0.0, 0.0)
    if i < gloss.shape[0]:
        own = wp.vec3(gloss[i, 0], gloss[i, 1], gloss[i, 2])
        turn = turn_of(entries, turns, turned, i)
        at = reflection_of(means[i], own, turn, environment, cameras[view[0]])
        if at.valid == 1:
            s = at.strength
            g_s = wp.float32(0.0)
            g_f = wp.float32(0.0)
            along_u = wp.float32(0.0)
            along_v = wp.float32(0.0)
            for c in range(3):
                e00 = environment[at.cell, c]
                e01 = environment[at.cell + 1, c]
                e10 = environment[at.cell + SIDE, c]
                e11 = environment[at.cell + SIDE + 1, c]
                colour = features[i][c]
                size = wp.abs(colour)
                inside = colour * size
                light_in = mirrored(environment, at, c)
                light = inside * at.left + s * light_in
                root = wp.sqrt(wp.max(wp.abs(light), DARK))
                slope = wp.where(wp.abs(light) > DARK, 0.5 / root, 1.0 / root)
                g = g_seen[i][c] * slope * wp.where(light / root > 1.0, OVER, 1.0)
                g_out[c] = g * 2.0 * size * at.left
                g_e = g * s
                wp.atomic_add(g_environment, at.cell, c, g_e * (1.0 - at.v) * (1.0 - at.u))
                wp.atomic_add(g_environment, at.cell + 1, c, g_e * (1.0 - at.v) * at.u)
                wp.atomic_add(g_environment, at.cell + SIDE, c, g_e * at.v * (1.0 - at.u))
                wp.atomic_add(g_environment, at.cell + SIDE + 1, c, g_e * at.v * at.u)
                wp.atomic_add(g_environment, SHEEN, c, g_e * at.grazing)
                g_s += g * light_in
                if s < 1.0:
                    g_s -= g * inside * FALL * at.grazing
                g_f += g_e * environment[SHEEN, c] - g * inside * FALL * wp.min(s, 1.0)
                along_u += g_e * ((1.0 - at.v) * (e01 - e00) + at.v * (e11 - e10))
                along_v += g_e * ((1.0 - at.u) * (e10 - e00) + at.u * (e11 - e01))
            along_u = along_u * STEP
            along_v = along_v * STEP
            upper = at.direction[2] >= 0.0
            g_x = wp.where(upper, along_u, -along_v * at.sign_x * at.sign_y)
            g_y = wp.where(upper, along_v, -along_u * at.sign_x * at.sign_y)
            both = (g_x * at.direction[0] + g_y * at.direction[1]) / at.length
            down = wp.where(upper, -both, both)
            g_p = wp.vec3(g_x - both * at.sign_x, g_y - both * at.sign_y, down) / at.length
            wp.atomic_add(g_environment, NEARNESS, 0, wp.dot(g_p, at.middle))
            away = 1.0 - at.cosine
            g_mu = 2.0 * wp.dot(g_p, at.normal) - 4.0 * g_f * away * away * away
            h = 2.0 * at.cosine * g_p + g_mu * at.view
            h = (h - wp.dot(h, at.normal) * at.normal) / s + g_s * at.normal
            g_own = h + change_of(conjugate(turn), h)
    if i < gloss.shape[0]:
        for k in range(3):
            g_gloss[i, k] = wp.where(adds == 1, g_gloss[i, k], 0.0) + g_own[k]
    g_features[i] = wp.where(adds == 1, g_features[i], wp.vec4(0.0, 0.0, 0.0, 0.0)) + g_out


@wp.kernel
def centre_environment(areas: wp.array[wp.float32], environment: wp.array2d[wp.float32]) -> None:
    """Makes the environment sum to 0 over the sphere and clamps the nearness to ≥ 0, with one thread per channel.

    Args:
        areas: [CELLS] fraction of the sphere covered by each cell.
        environment: [ROWS, 3] environment, updated in place.
    """
    c = wp.tid()
    mean = wp.float32(0.0)
    for cell in range(areas.shape[0]):
        mean += areas[cell] * environment[cell, c]
    for cell in range(areas.shape[0]):
        environment[cell, c] = environment[cell, c] - mean
    environment[NEARNESS, c] = wp.max(environment[NEARNESS, c], 0.0)


@wp.kernel
def weigh_neighbours(
    gloss: wp.array2d[wp.float32], neighbours: wp.array2d[wp.int32], weights: wp.array2d[wp.float32]
) -> None:
    """Computes equal weights for neighbours on the same side of a surface, with one thread per Gaussian.

    Args:
        gloss: [G, 3] normal of each Gaussian, scaled by its gloss strength.
        neighbours: [G, k] neighbours of each Gaussian, starting with the Gaussian itself.
        weights: [G, k] output, equal weights that sum to 1 in each row, or 0 for neighbours on another side or surface.
    """
    i = wp.tid()
    normal = wp.normalize(wp.vec3(gloss[i, 0], gloss[i, 1], gloss[i, 2]))
    total = wp.float32(0.0)
    for k in range(neighbours.shape[1]):
        j = neighbours[i, k]
        other = wp.normalize(wp.vec3(gloss[j, 0], gloss[j, 1], gloss[j, 2]))
        weight = wp.where(k == 0 or wp.dot(normal, other) > SAME_SIDE_COSINE, 1.0, 0.0)
        weights[i, k] = weight
        total += weight
    for k in range(neighbours.shape[1]):
        weights[i, k] = weights[i, k] / total


@wp.kernel
def smooth_changes(
    neighbours: wp.array2d[wp.int32],
    weights: wp.array2d[wp.float32],
    before: wp.array2d[wp.float32],
    gloss: wp.array2d[wp.float32],
    smooth: wp.array2d[wp.float32],
) -> None:
    """Averages the changes of the gloss since ``before`` over neighbours, with one thread per Gaussian.

    Args:
        neighbours, weights: [G, k] neighbours and their weights; see ``weigh_neighbours``.
        before: [G, 3] gloss of Θ_{t−1}.
        gloss: [G, 3] current gloss.
        smooth: [G, 3] output, smoothed gloss.
    """
    i = wp.tid()
    for c in range(3):
        change = wp.float32(0.0)
        for k in range(neighbours.shape[1]):
            j = neighbours[i, k]
            change += weights[i, k] * (gloss[j, c] - before[j, c])
        smooth[i, c] = before[i, c] + change


def features_seen(copies: DeviceCopies, state: Gaussians, cameras: wp.array, plain: wp.array | None = None) -> wp.array:
    """Returns the features of a state as seen by a camera, [N] vec4. The array must not be modified.

    Args:
        copies: device copies of the state's arrays.
        state: Gaussians to shade.
        cameras: [1] camera, of type ``Camera``.
        plain: [N] vec4 features without gloss; those of the state if None.
    """
    plain = features_on(copies, state) if plain is None else plain
    if state.gloss is None or state.environment is None:
        return plain
    seen, device = wp.empty_like(plain), plain.device
    view, turns = wp.zeros(1, dtype=wp.int32, device=device), wp.empty(0, dtype=wp.vec4, device=device)
    tables = copies.of(state.gloss, wp.float32), copies.of(state.environment, wp.float32)
    inputs = [cameras, view, copies.of(state.means, wp.vec3), view, turns, 0, *tables, plain, seen]  # without rotations
    wp.launch(shade, len(state), inputs, device=device)
    return seen


class GlossTables:
    """Gloss and environment parameters with their optimizers.

    Args:
        entries: [N] index of each Gaussian among those that rotate, or −1 for all others.
        glossy: number of glossy Gaussians, which precede all others.
        scalars: two [3] device arrays with the scalars of the optimizers for the gloss and environment.

    Attributes:
        glossy: same as the argument.
        seen: [N] vec4 features seen by the camera of the last rendering.
        g_seen: [N] vec4 gradients of ``seen``.
        tables: gloss [glossy, 3] and environment [ROWS, 3].
        gradients: gradients of ``tables`` in the last iteration.
        optimizers: optimizers for the gloss and environment.
    """

    def __init__(self, entries: wp.array, glossy: int, scalars: tuple[wp.array, wp.array]) -> None:
        device = self._device = scalars[0].device
        self._count = count = len(entries)
        self._entries, self.glossy = entries, glossy
        self.seen, self.g_seen = (wp.zeros(count, dtype=wp.vec4, device=device) for _ in range(2))
        shapes = (glossy, 3), (direction.ROWS, 3)
        self.tables, self.gradients = (
            [wp.zeros(shape, dtype=wp.float32, device=device) for shape in shapes] for _ in range(2)
        )
        self._areas = wp.array(cell_areas(direction.SIDE), dtype=wp.float32, device=device)
        self.optimizers = Optimizer(shapes[0], scalars[0]), Optimizer(shapes[1], scalars[1], varies_by_row=True)

    def begin(self, rates: tuple[float, float, float]) -> None:
        """Resets the moments to zero and sets the learning rates of the gloss, the environment and its nearness."""
        self.optimizers[0].begin([rates[0]] * 3, BETAS)
        self.optimizers[1].begin([1.0] * 3, BETAS, environment_rates(rates))

    def shade(
        self, cameras: wp.array, view: wp.array, means: wp.array, turns: wp.array | None, features: wp.array,
        tables: list[wp.array],
    ) -> None:  # fmt: skip
        """Fills ``seen`` with the features that a camera sees.

        Args:
            cameras: [views] cameras of all views.
            view: [1] index of the view.
            means: [N] vec3 means, in metres.
            turns: [M] vec4 rotations since the gloss was stored, or None if there are no rotations.
            features: [N] vec4 features without gloss.
            tables: gloss and environment, usually the ``tables`` attribute.
        """
        inputs = [cameras, view, means, *self._rotations(turns), *tables, features, self.seen]
        wp.launch(shade, self._count, inputs, device=self._device)

    def _rotations(self, turns: wp.array | None) -> list[object]:
        """Returns the kernel arguments for rotations. If ``turns`` is None, kernels do not read the array."""
        return [self._entries, self.seen if turns is None else turns, int(turns is not None)]

    def shade_backward(
        self, cameras: wp.array, view: wp.array, means: wp.array, turns: wp.array | None, features: wp.array,
        g_features: wp.array, add: bool,
    ) -> None:  # fmt: skip
        """Backpropagates ``g_seen`` to ``g_features`` and ``gradients``.

        Args:
            cameras, view, means, turns, features: see ``shade``.
            g_features: [N] vec4 output, gradients of ``features``.
            add: whether to add to the gradients of another view instead of overwriting them.
        """
        if not add:
            self.gradients[1].zero_()
        inputs = [cameras, view, means, *self._rotations(turns), *self.tables, features, int(add), self.g_seen]
        wp.launch(shade_backward, self._count, [*inputs, g_features, *self.gradients], device=self._device)

    def step(self) -> None:
        """Takes an Adam step for both tables."""
        for optimizer, table, gradient in zip(self.optimizers, self.tables, self.gradients, strict=True):
            wp.launch(step_table, table.shape, [optimizer.adam, gradient, table], device=self._device)
        wp.launch(centre_environment, 3, [self._areas, self.tables[1]], device=self._device)


class WarpGloss(GlossTables):
    """Gloss and environment parameters of an attempt.

    Args:
        entries: [N] index of each Gaussian among the moving ones, or −1 for static Gaussians.
        roots: [glossy] positions of the glossy Gaussians in frame 0, in metres, used to find neighbours.
        scalars, environment_scalars: [3] device arrays with the scalars of the optimizers for gloss and environment.

    Attributes:
        before: gloss and environment of Θ_{t−1}.
    """

    def __init__(
        self, entries: wp.array, roots: wp.array, scalars: wp.array, environment_scalars: wp.array
    ) -> None:  # fmt: skip
        super().__init__(entries, len(roots), (scalars, environment_scalars))
        self.before = [wp.zeros_like(table) for table in self.tables]
        self._smooth = wp.zeros_like(self.tables[0])
        self._neighbours, _ = nearest(roots, min(NEIGHBOURS, self.glossy), own=True)
        self._weights = wp.zeros(self._neighbours.shape, dtype=wp.float32, device=self._device)

    def load(self, previous: Gaussians, copies: DeviceCopies) -> None:
        """Loads the gloss and environment of Θ_{t−1}."""
        assert previous.gloss is not None
        assert previous.environment is not None
        for table, values in zip(self.before, (previous.gloss, previous.environment), strict=True):
            wp.copy(table, copies.of(values, wp.float32))
        self._rates = gloss_rate(UPDATE_RATE_GLOSS, previous.gloss), UPDATE_RATE_ENVIRONMENT, UPDATE_RATE_NEARNESS
        self.reset()

    def reset(self) -> None:
        """Starts an attempt with the parameters of Θ_{t−1} and zero moments."""
        for table, values in zip(self.tables, self.before, strict=True):
            wp.copy(table, values)
        self.begin(self._rates)

    def smooth(self, first: bool) -> None:
        """Averages the gloss changes since Θ_{t−1} over neighbours.

        Args:
            first: whether this is the first call of an attempt, which computes the weights of the neighbours.
        """
        gloss = self.tables[0]
        if first:
            inputs = [gloss, self._neighbours, self._weights]
            wp.launch(weigh_neighbours, self.glossy, inputs, device=self._device)
        inputs = [self._neighbours, self._weights, self.before[0], gloss, self._smooth]
        wp.launch(smooth_changes, self.glossy, inputs, device=self._device)
        wp.copy(gloss, self._smooth)
