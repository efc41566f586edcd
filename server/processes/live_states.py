"""Compact records of a scene's newest states for its stream subscribers, encoded once for all of them."""

from __future__ import annotations

from scas4d_core.compact import FileError, LiveEncoder
from scas4d_core.storage.history import History
from server.messages import SceneSpec
from server.processes.compact_answers import compact_head
from server.processes.queries import StatesQuery

MAX_GAP = 30
"""Maximum number of frames between two encoded states; after a longer gap, encoding starts anew.

Nobody was watching in the meantime, and states encoded relative to newer ones are smaller.
"""


class LiveStateEncoder:
    """Encoder of a scene's newest states, which starts anew if a state cannot continue the previous one.

    Args:
        spec: scene specification.
    """

    def __init__(self, spec: SceneSpec) -> None:
        self._spec = spec
        self._encoder: LiveEncoder | None = None

    def records(self, history: History, query: StatesQuery) -> tuple[bytes, dict[str, str]]:
        """Returns the records that bring a subscriber to a frame, and headers.

        X-Encoder identifies the encoder. X-After is the frame that the records continue from; it is absent if they
        start a new file.
        """
        encoder = self._encoder
        if encoder is None or not encoder.last_frame <= query.frame <= encoder.last_frame + MAX_GAP:
            encoder = LiveEncoder(compact_head(self._spec, history))
        if query.frame > encoder.last_frame:
            state, time = history.gaussians(query.frame), history.time(query.frame)
            self._encoder = None  # an encoder that fails may have registered a part of the frame
            try:
                encoder.add(query.frame, time, state)
            except FileError:  # for example, if opacities were refitted in a recomputed state
                encoder = LiveEncoder(compact_head(self._spec, history))
                encoder.add(query.frame, time, state)
            self._encoder = encoder
        after = query.after if query.encoder == encoder.name else None
        headers = {"X-Encoder": encoder.name} | ({} if after is None else {"X-After": str(after)})
        return encoder.records_after(after), headers
