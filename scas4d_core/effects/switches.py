"""On/off switches of a scene's effects, which are pinned by the settings or set by evidence, with hysteresis.

A switch changes only between two frames. The change is committed with the frame whose evidence caused it. A resumed
scene continues with the switches of its checkpoint, so a replay makes the same decisions.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from scas4d_core.effect_names import EFFECTS, Mode
from scas4d_core.effects.effect import Effect, effect
from scas4d_core.errors import InputError
from scas4d_core.settings import Settings

if TYPE_CHECKING:
    from scas4d_core.effects.evidence import Evidence, FrameObservation
    from scas4d_core.update.parts import Arrays, PlanBuilder

IDLE = 8
"""Number of consecutive frames with too little evidence after which an effect is switched off."""


@dataclass(frozen=True)
class Switch:
    """The switch of one effect.

    Attributes:
        on: whether the effect contributes to updates.
        since: index of the frame after which the switch last changed.
        pinned: whether the settings pin the switch.
        share, text: latest evidence; see ``Evidence``.
        idle: number of consecutive frames with evidence below the switch-off threshold.
    """

    on: bool
    since: int
    pinned: bool = False
    share: float = 0.0
    text: str = ""
    idle: int = 0


Switches = Mapping[str, Switch]
NO_EVIDENCE: Mapping[str, Evidence] = MappingProxyType({})
"""Empty mapping, used if there is no evidence for any effect."""


def find_contradictions(settings: Settings) -> Iterator[tuple[str, Mode, str, str]]:
    """Yields the name, mode, problem and remedy of each effect whose pin contradicts the settings."""
    for name, mode in settings.effects.items():
        if mode == "on" and (refusal := effect(name).refusal(settings)) is not None:
            yield (
                name,
                mode,
                f"effects.{name} cannot be 'on': {refusal[0]}",
                f"{refusal[1]}, or set the effect to 'auto'",
            )
        if mode == "off" and (refusal := effect(name).requirement(settings)) is not None:
            yield name, mode, f"effects.{name} cannot be 'off': {refusal[0]}", refusal[1]


def first_switches(
    settings: Settings, index: int, found: Mapping[str, Evidence] = NO_EVIDENCE, masked: bool = True
) -> dict[str, Switch]:
    """Returns the switches before any update: pinned, on by default, or switched on by evidence in frame 0.

    Args:
        settings: settings of the scene.
        index: index of the first frame.
        found: evidence from the fit of frame 0, keyed by effect name.
        masked: whether frame 0 has masks.

    Raises:
        InputError: if a pinned effect contradicts the settings.

    >>> from scas4d_core.settings import Settings
    >>> switches = first_switches(Settings.model_validate({"effects": {"rigidity": "off"}}), 0)
    >>> switches["rigidity"].on, switches["isometry"].on, switches["floor"].on  # no floor is given
    (False, True, False)
    """
    for _, _, fault, remedy in find_contradictions(settings):
        raise InputError(fault, remedy)
    switches = {}
    for name in EFFECTS:
        mode, one = settings.effects.get(name, "auto"), effect(name)
        refused = one.refusal(settings)
        allowed = mode == "auto" and refused is None
        on = mode == "on" or (allowed and not one.auto)
        evidence = found.get(name)
        if evidence is not None and allowed and one.auto:
            on = evidence.share >= one.on_above
        share, text = (0.0, "") if evidence is None else (evidence.share, evidence.text)
        if allowed and not masked and not one.without_masks:
            on, text = False, "the first frame has no masks"
        switches[name] = Switch(on, index, mode != "auto", share, text)
    return switches


def encode_switches(switches: Switches) -> dict[str, dict[str, Any]]:
    """Returns the switches as JSON data, for reports and checkpoints."""
    return {name: dict(vars(switch)) for name, switch in switches.items()}


def decode_switches(record: Mapping[str, Mapping[str, Any]]) -> dict[str, Switch]:
    """Returns the switches decoded from JSON data.

    >>> decode_switches(encode_switches({"floor": Switch(on=True, since=3)}))["floor"].since
    3
    """
    return {name: Switch(**values) for name, values in record.items()}


def decide_switches(switches: Switches, settings: Settings, seen: FrameObservation) -> dict[str, Switch]:
    """Returns the switches for the next frame.

    Args:
        switches: switches used for the update of the frame.
        settings: settings of the scene.
        seen: the learnt frame.
    """
    return {name: _decide_switch(name, switch, settings, seen) for name, switch in switches.items()}


def _decide_switch(name: str, switch: Switch, settings: Settings, seen: FrameObservation) -> Switch:
    one = effect(name)
    if switch.pinned or not one.auto or one.refusal(settings) is not None:
        return switch
    evidence = one.evidence(seen)
    if evidence is None:
        return switch
    switch = replace(switch, share=evidence.share, text=evidence.text)
    if not switch.on:
        return replace(switch, on=True, since=seen.index, idle=0) if evidence.share >= one.on_above else switch
    idle = switch.idle + 1 if evidence.share < one.off_below else 0
    return replace(switch, on=False, since=seen.index, idle=0) if idle >= IDLE else replace(switch, idle=idle)


def first_frame_arrays(switches: Switches, settings: Settings, seen: FrameObservation) -> dict[str, Arrays]:
    """Returns the arrays of the first frame that the effects need in later frames, keyed by effect name."""
    by_effect = {}
    for name, switch in switches.items():
        one = effect(name)
        if (switch.on or not switch.pinned) and effect(name).refusal(settings) is None:
            arrays = one.first_frame_arrays(seen)
            if arrays is not None:
                by_effect[name] = arrays
    return by_effect


def record_arrays(switches: Switches, settings: Settings, seen: FrameObservation) -> FrameObservation:
    """Returns the observation of a learnt frame, extended by the arrays that the effects record.

    Args:
        switches: switches used for the update of the frame.
        settings: settings of the scene.
        seen: the learnt frame.
    """
    by_effect = {}
    for name, switch in switches.items():
        one = effect(name)
        asked = type(one).record is not Effect.record and (switch.on or not switch.pinned)
        if asked and effect(name).refusal(settings) is None:
            arrays = one.record(seen, switch.on)
            if arrays is not None:
                by_effect[name] = arrays
    if not by_effect:
        return seen
    return replace(seen, result=replace(seen.result, carried={**seen.result.carried, **by_effect}))


def committed_arrays(carried: Mapping[str, Arrays]) -> dict[str, Arrays]:
    """Returns the carried arrays that are committed with later frames, keyed by effect name."""
    kept = {
        name: {key: own[key] for key in effect(name).committed_arrays if key in own} for name, own in carried.items()
    }
    return {name: own for name, own in kept.items() if own}


def switches_after_first_frame(
    found: Mapping[str, Arrays], switches: Switches, seen: FrameObservation
) -> dict[str, Switch]:
    """Returns the switches after the first frame.

    Args:
        found: arrays returned by ``first_frame_arrays``, keyed by effect name.
        switches: switches before the first frame.
        seen: the first frame.
    """
    return {
        name: replace(switch, on=True) if name in found and effect(name).on_at_first(seen) else switch
        for name, switch in switches.items()
    }


def names_on(switches: Switches) -> tuple[str, ...]:
    """Returns the names of the active effects in registry order."""
    return tuple(name for name in EFFECTS if name in switches and switches[name].on)


def register_effects(builder: PlanBuilder, effects: Sequence[str] | None = None) -> PlanBuilder:
    """Registers effects with a builder and returns the builder.

    Args:
        builder: builder of the update plan.
        effects: names of the active effects; defaults to the effects that are on without evidence.
    """
    if effects is None:
        effects = names_on(first_switches(Settings(scene=builder.scene, update=builder.update), 0))
    for name in effects:
        effect(name).register(builder)
    return builder
