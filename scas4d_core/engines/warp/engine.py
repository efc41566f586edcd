"""GPU engine for updates in Warp, which runs each iteration in the order given by algorithm 1.

The kernel launches of an iteration are captured in a CUDA graph. Kernels read all values that change between iterations
from device memory (``StepRecords``), so the host only enqueues graphs. Losses and results are downloaded when the
update loop requests them. If a tile list turns out to be too small, the lists are enlarged and the attempt is repeated.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

from scas4d_core.engines.engine import (
    GAINS_MISSING,
    KEPT_PICTURES,
    AttemptStart,
    IterationLog,
    Probe,
    StepScalars,
    Tables,
    ViewRecord,
)
from scas4d_core.engines.plan import Structure, UpdatePlan
from scas4d_core.engines.renderer import psnr_of
from scas4d_core.engines.views import LABEL, TrainingView
from scas4d_core.engines.warp.adam import COUNTED_GUARDS as ADAM_GUARDS
from scas4d_core.engines.warp.adam import IDLE
from scas4d_core.engines.warp.colours import WarpColours
from scas4d_core.engines.warp.copies import as_numbers, copies_on, features_on, structures_on
from scas4d_core.engines.warp.deformation import WarpDeformation
from scas4d_core.engines.warp.downloads import Downloads
from scas4d_core.engines.warp.gains import WarpGains
from scas4d_core.engines.warp.gloss import WarpGloss
from scas4d_core.engines.warp.graphs import Graphs
from scas4d_core.engines.warp.layout import IMAGE_LOSS, MASK_LOSS, PAIRS, SHIFT, SQUARES
from scas4d_core.engines.warp.pictures import PicturePass, thinned
from scas4d_core.engines.warp.projection import COUNTED_GUARDS as RENDERING_GUARDS
from scas4d_core.engines.warp.renderer import WarpRenderer
from scas4d_core.engines.warp.step_records import StepRecords
from scas4d_core.gaussians import Gaussians, turned_rotations
from scas4d_core.guards import GuardCounts, summed

Array = NDArray[np.float32]

MOST_VIEWS = 8
"""Maximum number of views per iteration, the limit of the setting ``update.views``."""
LOG_ROWS = 1024
"""Maximum number of renderings that the device logs before the host must read the log."""
ITERATIONS = "iterations"
"""Name of the update stage in which the host enqueues iterations."""
STATES_AT_ONCE = 2
"""Maximum number of states that one call of ``probe`` compares with every probe view."""
AHEAD = 2
"""Maximum number of pending iterations, which bounds how far host timings run ahead of the device."""


class Variant(NamedTuple):
    """Parameters that determine which kernels an iteration launches.

    Attributes:
        views: number of views.
        unchanged: number of layers whose output has not changed since the previous iteration.
        frozen: number of layers without a backward pass.
        keeps: whether the renderings are kept in the log.
        smooths: whether the gloss is smoothed after this iteration.
        smooths_first: whether the gloss is smoothed for the first time in this attempt.
    """

    views: int
    unchanged: int
    frozen: int
    keeps: bool
    smooths: bool
    smooths_first: bool


class WarpEngine:
    """The ``UpdateEngine`` implementation in NVIDIA Warp, for GPUs and Warp's CPU device.

    Args:
        device: Warp device, such as "cpu" or "cuda:0".

    Attributes:
        name: name of the engine, used in messages.
        renderer: renderer for states, with the plan's background and limits.
        downloads: helper that copies device arrays to the host.
    """

    name = "warp"
    renderer: WarpRenderer

    def __init__(self, device: str = "cuda:0") -> None:
        self._device = device
        self.downloads = Downloads(device)
        self._copies = copies_on(device)

    def bind(self, plan: UpdatePlan, structure: Structure) -> None:
        """See ``UpdateEngine.bind``. This engine supports all plans."""
        self._plan, self._structure, self._rows = plan, structure, structure.hierarchy.rows
        count, device, layers = len(structure.roots), self._device, len(structure.hierarchy.sizes)
        self.renderer = WarpRenderer(plan.background, plan.limits, device, plan.image)
        # Optimizers: one per layer, followed by one each for the deltas, colours, gloss and environment.
        self._records = StepRecords(device, layers + 4, MOST_VIEWS, LOG_ROWS)
        _, colours, *self._gloss_scalars = (self._records.optimizer(layers + k) for k in range(4))
        self._deformation = WarpDeformation(device, plan, structure, self._records)
        self._pictures = PicturePass(device, plan, count)
        self._colours = None if plan.colours is None else WarpColours(plan, self._deformation.entries, colours)
        self._gains = WarpGains(device, len(plan.cameras)) if plan.camera_gains else None
        self._gloss: WarpGloss | None = None
        self._opacities = wp.zeros(count, dtype=wp.float32, device=device)
        self._features, self._previous_features = (wp.zeros(count, dtype=wp.vec4, device=device) for _ in range(2))
        self._losses = wp.zeros(LOG_ROWS, dtype=wp.float32, device=device)
        self._probe_view, self._probe_row = (wp.zeros(1, dtype=wp.int32, device=device) for _ in range(2))
        self._camera_rows = {name: row for row, name in enumerate(plan.cameras)}
        self._graphs, self._captured_for, self._generation = Graphs(device), object(), -1
        self._events: deque[wp.Event] = deque()
        self._tables: Tables | None = None
        self._state: list[NDArray[Any]] | None = None
        self._views: list[TrainingView] = []

    def load_views(self, views: Sequence[TrainingView], probes: Sequence[TrainingView]) -> None:
        """See ``UpdateEngine.load_views``."""
        self._views = list(views)
        self._pictures.load_views([*views, *probes])
        self._pictures.reserve(LOG_ROWS + STATES_AT_ONCE * len(probes))
        if self._gains is not None:
            rows = [self._camera_rows[view.name] for view in (*views, *probes)]
            if self._gains.load_views(rows, len(views)):
                self._graphs.forget()

    def load_state(self, previous: Gaussians) -> None:
        """See ``UpdateEngine.load_state``."""
        self._previous, copies = previous, self._copies
        means, factors = copies.of(previous.means, wp.vec3), copies.of(previous.factors, wp.mat33)
        self._deformation.load_state(means, factors)
        wp.copy(self._opacities, copies.of(previous.opacities, wp.float32))
        wp.copy(self._previous_features, features_on(copies, previous))
        self._load_gloss()
        self._pictures.forget_guards()
        self._start: AttemptStart | None = None
        self._reset()

    def _load_gloss(self) -> None:
        """Loads the gloss of Θ_{t−1}, if any."""
        previous, before = self._previous, self._gloss
        if previous.gloss is None or previous.environment is None:
            self._gloss = None
        elif before is None or before.glossy != len(previous.gloss):
            roots = structures_on(self._device).of(self._structure.roots, wp.vec3)[: len(previous.gloss)]
            self._gloss = WarpGloss(self._deformation.entries, roots, *self._gloss_scalars)
        if self._gloss is not before:
            self._graphs.forget()
        if self._gloss is not None:
            self._gloss.load(previous, self._copies)

    @property
    def _learnt_gloss(self) -> WarpGloss | None:
        """Gloss to learn, or None if the plan does not learn gloss and iterations render without it."""
        return self._gloss if self._plan.gloss else None

    def set_tables(self, tables: Tables) -> None:
        """See ``UpdateEngine.set_tables``."""
        if self._pending:  # if they were repeated later, they would replace the tables
            self._settle()
        self._deformation.set_tables(tables)
        self._unchanged = 0
        self._tables = self._state = None

    def begin(self, start: AttemptStart) -> None:
        """See ``UpdateEngine.begin``."""
        self._start = start
        replaced = self._deformation.begin(start)
        captured_for = start.beta1, start.beta2, start.gains is None
        if replaced or captured_for != self._captured_for:
            self._graphs.forget()
        self._captured_for = captured_for
        self._reset()

    def _reset(self) -> None:
        """Restores everything that iterations modify to its state at the start of the attempt."""
        wp.copy(self._features, self._previous_features)
        self._losses.zero_()
        self._log, self._history = IterationLog(), list[tuple[Sequence[int], StepScalars | None]]()
        self._log_is_unread = True
        self._pending: list[Sequence[int]] = []
        self._slots: dict[int, int] = {}
        self._used_rows = self._unchanged = 0
        self._smoothed = self._keeps_unread = False
        self._tables = self._state = None
        if self._start is None:
            return
        self._deformation.restart(self._start)
        if self._colours is not None:
            self._colours.begin(self._start)
        if self._gloss is not None:
            self._gloss.reset()
        if self._gains is not None and self._start.gains is not None:
            self._gains.begin(self._start.gains, self._pictures.exposures)

    def iterate(self, views: Sequence[int], step: StepScalars) -> None:
        """See ``UpdateEngine.iterate``."""
        if self._used_rows + len(views) > LOG_ROWS:
            self._settle()
        self._history.append((views, step))
        self._log_is_unread = True
        self._tables = self._state = None
        keeps = [self._slot(view) if step.keep_pictures else 0 for view in views]
        rows = range(self._used_rows, self._used_rows + len(views))
        self._records.write(
            step.sample, len(self._pending), list(zip(views, rows, keeps, strict=True)), self._scalars(step)
        )
        smooths = step.smooth_gloss and self._learnt_gloss is not None
        first = smooths and not self._smoothed
        variant = Variant(len(views), self._unchanged, step.frozen, step.keep_pictures, smooths, first)
        if self._pictures.generation != self._generation:  # captured graphs contain the addresses of old buffers
            self._graphs.forget()
            self._generation = self._pictures.generation
        self._graphs.run(variant, partial(self._launch, variant))
        self._pending.append(views)
        self._used_rows += len(views)
        self._unchanged, self._smoothed = step.frozen, self._smoothed or step.smooth_gloss
        assert self._start is not None  # `begin` is called before iterations
        self._start.lap(ITERATIONS)

    def _slot(self, view: int) -> int:
        """Returns the slot for a view's rendering, following the replacement order of ``IterationLog.keep``."""
        self._keeps_unread = True
        slot = self._slots.pop(view, len(self._slots))
        if slot == KEPT_PICTURES:
            slot = self._slots.pop(next(iter(self._slots)))
        self._slots[view] = slot
        return slot

    def _scalars(self, step: StepScalars) -> list[float]:
        """Returns an iteration's scalars for ``StepRecords.write``, and advances the step counts of all optimizers."""
        scalars = self._deformation.scalars(step)
        scalars += IDLE if self._colours is None else self._colours.optimizer.next_scalars(step.colour)
        gloss = self._learnt_gloss
        for place in range(2):
            scalars += IDLE if gloss is None else gloss.optimizers[place].next_scalars(step.gloss)
        return scalars

    def _launch(self, variant: Variant) -> None:
        """Enqueues the kernel launches of an iteration."""
        deformation, pictures, gloss = self._deformation, self._pictures, self._learnt_gloss
        deformation.forward(variant.unchanged)
        for place in range(variant.views):
            self._launch_view(place, variant)
        deformation.backward(pictures.grad_means, pictures.grad_factors, variant.frozen, self._losses)
        if self._colours is not None:
            tables = self._previous_features, pictures.grad_features, self._features
            before, gradients, features = (as_numbers(array) for array in tables)
            self._colours.step(before, gradients, features, self._records.iteration, self._losses)
        if gloss is not None:
            gloss.step()
            if variant.smooths:
                gloss.smooth(variant.smooths_first)

    def _launch_view(self, place: int, variant: Variant) -> None:
        """Enqueues the rendering and backward pass for one of the iteration's views."""
        deformation, pictures, gloss = self._deformation, self._pictures, self._learnt_gloss
        view, record, slot = self._records.view(place)
        shapes = deformation.means, deformation.factors, self._opacities
        weight, add = 1.0 / variant.views, place > 0
        if gloss is None:
            pictures.launch(view, record, *shapes, self._features, weight, add=add)
        else:
            seen = pictures.cameras, view, deformation.means, deformation.turns, self._features
            gloss.shade(*seen, gloss.tables)
            gloss.g_seen.zero_()
            pictures.launch(view, record, *shapes, gloss.seen, weight, add=add, grad_features=gloss.g_seen)
            gloss.shade_backward(*seen, pictures.grad_features, add)
        if variant.keeps:
            pictures.keep(view, slot)
        if self._gains is not None and self._start is not None and self._start.gains is not None:
            self._gains.record(pictures.cameras, view, pictures.planes, pictures.targets, pictures.exposures)

    def leave_out(self, views: Sequence[int]) -> None:
        """See ``UpdateEngine.leave_out``."""
        self._history.append((views, None))
        if self._gains is not None:
            left_out = {view for entry, step in self._history if step is None for view in entry}
            self._gains.leave_out(left_out)

    def wait(self, iteration: int) -> None:
        """See ``UpdateEngine.wait``. At most ``AHEAD`` iterations remain pending."""
        if wp.get_device(self._device).is_cuda:
            self._events.append(wp.get_stream(self._device).record_event())
            if len(self._events) > AHEAD:
                wp.synchronize_event(self._events.popleft())

    def _settle(self) -> None:
        """Reads the log of all pending iterations, repeating the attempt until all tile lists are large enough."""
        while self._log_is_unread and self._read_log() is None:
            pass

    def _read_log(self, probed: int = 0, with_state: bool = False) -> Array | None:
        """Waits for the device, and reads the log of the pending iterations and the losses of the probes.

        Args:
            probed: number of renderings that probes have logged.
            with_state: whether to read the learnt state as well, for the next call of ``state``.

        Returns:
            [probed] image losses; or None if an image was incomplete because its tile lists were too small. In this
            case, the lists have been enlarged. If an iteration was affected, all iterations have been enqueued again.
        """
        self._log_is_unread = False
        guards = self._deformation.unsound, self._pictures.guard_counts, *self._adam_counts()
        kept = [self._pictures.kept] if self._keeps_unread else []
        state = self._arrays_of_state(learnt=True) if with_state else []
        read = self.downloads.read(self._pictures.log, self._losses, *guards, *kept, *state)
        self._state = read[len(read) - len(state) :] or None
        log, losses, unsound, rendered, *values = read[: len(read) - len(state)]
        rows, probe_rows = log[: self._used_rows], log[LOG_ROWS : LOG_ROWS + probed]
        if self._pictures.grow(rows[:, PAIRS].max(initial=0)):
            self._repeat()
            return None
        if kept:
            self._keeps_unread = False
            pictures = values.pop()
            for view, slot in self._slots.items():
                self._log.keep(view, thinned(pictures[slot], self._views[view]))
        counts = [guard_counts(RENDERING_GUARDS, rendered), *(guard_counts(ADAM_GUARDS, each) for each in values)]
        triggered = dict(summed(counts)) | {"held_back": int(unsound[0])}
        self._log.guards = {name: count for name, count in triggered.items() if count}
        first = 0
        for views, terms in zip(self._pending, losses, strict=False):
            own = rows[first : first + len(views)]
            self._log.rendered += [
                record_of(view, row, self._views[view]) for view, row in zip(views, own, strict=True)
            ]
            self._log.losses.append(float(own[:, [IMAGE_LOSS, MASK_LOSS]].sum() / len(views) + terms))
            first += len(views)
        self._pending, self._used_rows = [], 0
        self._losses.zero_()
        return None if self._pictures.grow(probe_rows[:, PAIRS].max(initial=0)) else probe_rows[:, IMAGE_LOSS]

    def _repeat(self) -> None:
        """Enqueues all iterations of the attempt again, after buffers were reallocated."""
        history = self._history
        self._pictures.forget_guards()
        self._reset()
        for views, step in history:
            if step is None:
                self.leave_out(views)
            else:
                self.iterate(views, step)

    def probe(self, *probes: Probe, state_next: bool = False) -> list[list[float]]:
        """See ``UpdateEngine.probe``."""
        ends = np.cumsum([len(probe.views) for probe in probes])
        if LOG_ROWS + ends[-1] > len(self._pictures.log):
            raise ValueError(f"cannot render {ends[-1]} probe views at once; use {STATES_AT_ONCE} states at most")
        losses = None
        while losses is None:
            for probe, end in zip(probes, ends, strict=True):
                self._launch_probe(probe, LOG_ROWS + int(end) - len(probe.views))
            losses = self._read_log(int(ends[-1]), state_next)
        return [each.tolist() for each in np.split(losses, ends[:-1])]

    def _launch_probe(self, probe: Probe, row: int) -> None:
        """Enqueues the renderings of a probe, which log their losses from the given row on."""
        deformation, pictures, learnt = self._deformation, self._pictures, probe.learnt
        means, factors = deformation.previous
        if probe.moved:
            deformation.forward()
            means, factors = deformation.means, deformation.factors
        features = self._features if learnt else self._previous_features
        turns = deformation.turns if probe.moved else None
        for place, index in enumerate(probe.views):
            self._probe_view.fill_(len(self._views) + index)
            self._probe_row.fill_(row + place)
            seen = features
            if self._gloss is not None:
                tables = self._gloss.tables if learnt else self._gloss.before
                self._gloss.shade(pictures.cameras, self._probe_view, means, turns, features, tables)
                seen = self._gloss.seen
            pictures.measure(self._probe_view, self._probe_row, means, factors, self._opacities, seen)

    def tables(self) -> Tables:
        """See ``UpdateEngine.tables``. The host does not wait if the tables were read with the state."""
        if self._tables is None:
            self._settle()
            self._tables = self._deformation.tables_of(
                self._state or self.downloads.read(*self._deformation.parameters)
            )
        return self._tables

    def log(self) -> IterationLog:
        """See ``UpdateEngine.log``. The host only waits if it has not read the log since the last iteration."""
        self._settle()
        return self._log

    def _adam_counts(self) -> list[wp.array]:
        """Returns the number of times that the guards of each optimizer were triggered."""
        optimizers = [*self._deformation.optimizers]
        optimizers += [] if self._colours is None else [self._colours.optimizer]
        optimizers += [] if self._learnt_gloss is None else self._learnt_gloss.optimizers
        return [each.adam.guard_counts for each in optimizers]

    def state(self, learnt: bool) -> Gaussians:
        """See ``UpdateEngine.state``."""
        self._settle()
        previous, deformation = self._previous, self._deformation
        values = (self._state if learnt else None) or self.downloads.read(*self._arrays_of_state(learnt))
        means, factors, turns, *looks = values[len(deformation.parameters) :]
        self._tables = deformation.tables_of(values)
        rotations = turned_rotations(previous.rotations, self._rows, turns)
        state = previous.replace(means=means, factors=factors, rotations=rotations)
        self._copies.store(wp.clone(deformation.means), means)
        self._copies.store(wp.clone(deformation.factors), factors)
        if not learnt:
            return state
        state = state.replace(colours=np.ascontiguousarray(looks[0][:, :LABEL]))
        self._copies.store(wp.clone(self._features), state.colours, state.foreground)
        if self._gloss is None:
            return state
        for table, host in zip(self._gloss.tables, looks[1:], strict=True):
            self._copies.store(wp.clone(table), host)
        return state.replace(gloss=looks[1], environment=looks[2])

    def _arrays_of_state(self, learnt: bool) -> list[wp.array]:
        """Deforms Θ_{t−1}, and returns the device arrays that ``state`` reads, starting with the parameters."""
        deformation = self._deformation
        deformation.forward()
        arrays = [*deformation.parameters, deformation.means, deformation.factors, deformation.turns]
        if learnt:
            arrays += [self._features, *([] if self._gloss is None else self._gloss.tables)]
        return arrays

    def exposures(self) -> Mapping[str, Array]:
        """See ``UpdateEngine.exposures``."""
        if self._gains is None:
            return {view.name: view.exposure.copy() for view in self._views}
        self._settle()
        (exposures,) = self.downloads.read(self._pictures.exposures)
        return {view.name: exposures[row, : len(view.exposure)].copy() for row, view in enumerate(self._views)}

    def gains(self) -> Array:
        """See ``UpdateEngine.gains``."""
        if self._gains is None or self._start is None or self._start.gains is None:
            raise ValueError(GAINS_MISSING)
        self._settle()
        return self._gains.finish(self._pictures.exposures, self.downloads)

    def gradients(self) -> dict[str, Array]:
        """See ``UpdateEngine.gradients``. The gradients of frozen layers are stale."""
        *clusters, deltas = self.downloads.read(*self._deformation.gradients)
        tables = {f"cluster {k}": gradient for k, gradient in enumerate(clusters)} | {"deltas": deltas}
        if self._colours is not None:
            (tables["colours"],) = self.downloads.read(self._colours.gradients)
        if self._learnt_gloss is not None:
            tables["gloss"], tables["environment"] = self.downloads.read(*self._learnt_gloss.gradients)
        return tables


def record_of(index: int, row: Array, view: TrainingView) -> ViewRecord:
    """Converts a row of the device's log to a ``ViewRecord``."""
    height, width = view.target.shape[1:]
    red, green, blue = row[SHIFT : SHIFT + LABEL].tolist()
    return ViewRecord(index, psnr_of(float(row[SQUARES]), height * width), (red, green, blue))


def guard_counts(names: Sequence[str], values: NDArray[np.int32]) -> GuardCounts:
    """Converts guard counts from the device to ``GuardCounts``."""
    counts = GuardCounts(*names)
    counts.add(names, values.astype(np.int64))
    return counts
