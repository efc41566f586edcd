"""Tokens that may only read, for a time: of one scene, as links to share have them, or of all.

Such a token is `scas4d.read.<scene or *>.<end>.<signature>`: the end in seconds since the epoch, the signature an
HMAC-SHA256 of what stands before it. Nothing is kept: another token of the service ends them all.
"""

from __future__ import annotations

import time

from server.http.permissions import Permission
from server.http.signing import Signer
from server.problems import Problem

PREFIX = "scas4d.read."
ALL_SCENES = "*"
LONGEST_SECONDS = 10 * 366 * 86_400
"""Ten years: a monitor's token."""


class Sharing:
    """Makes and reads tokens that may only read.

    Args:
        secret: the token of the service.
    """

    def __init__(self, secret: str) -> None:
        self._signer = Signer(secret, "scas4d tokens that may only read")

    def issue(self, scene: str | None, end: int) -> str:
        """Makes a token for a scene, or for all, that ends then; `end` in seconds since the epoch."""
        return self._signer.sign(f"{PREFIX}{ALL_SCENES if scene is None else scene}.{end}")

    def read(self, token: str) -> Permission | None:
        """Returns what the bearer of a token may do; None where it was not made here.

        Raises:
            Problem: 401, it has ended.
        """
        text = self._signer.read(token)
        if text is None:
            return None
        scene, _, end = text.removeprefix(PREFIX).rpartition(".")
        if int(end) <= time.time():
            raise Problem(
                401,
                "the link, or the token for reading, has ended",
                field="Authorization",
                remedy="ask for a new link where you got it: POST /v1/shares, or scas4d scenes share",
                headers={"WWW-Authenticate": 'Bearer realm="scas4d", error="invalid_token"'},
            )
        return Permission(scene=None if scene == ALL_SCENES else scene, end=int(end))
