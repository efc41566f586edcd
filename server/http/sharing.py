"""Read-only tokens with an expiry time, for one scene (as in share links) or for all scenes.

A token has the form `scas4d.read.<scene or *>.<end>.<signature>`. `end` is the expiry time in seconds since the epoch,
and `signature` is an HMAC-SHA256 of the text before it (itsdangerous). The service does not store these tokens;
changing its own token revokes all of them.
"""

from __future__ import annotations

import hashlib
import time
from typing import Any

from itsdangerous import BadSignature, Signer

from server.http.permissions import Permission
from server.problems import Problem

PREFIX = "scas4d.read."
ALL_SCENES = "*"
LONGEST_SECONDS = 10 * 366 * 86_400
"""Maximum lifetime of a token in seconds; ten years, for the tokens of monitoring systems."""
HMAC_SHA256: dict[str, Any] = {"key_derivation": "hmac", "digest_method": hashlib.sha256}
"""Options of every signer; the default digest of itsdangerous is SHA-1."""


class Sharing:
    """Issuer and verifier of read-only tokens.

    Args:
        secret: the service's token.
    """

    def __init__(self, secret: str) -> None:
        self._signer = Signer(secret, "scas4d tokens that may only read", **HMAC_SHA256)

    def issue(self, scene: str | None, end: int) -> str:
        """Returns a token for a scene, or for all scenes if `scene` is None.

        The token expires at `end`, in seconds since the epoch.
        """
        return self._signer.sign(f"{PREFIX}{ALL_SCENES if scene is None else scene}.{end}").decode()

    def read(self, token: str) -> Permission | None:
        """Returns the permission granted by a token, or None if the token was not signed by this service.

        Raises:
            Problem: 401 if the token has expired.
        """
        try:
            text = self._signer.unsign(token.encode(errors="replace")).decode()
        except BadSignature:
            return None
        scene, _, end = text.removeprefix(PREFIX).rpartition(".")
        if int(end) <= time.time():
            raise Problem(
                401,
                "the link or read-only token has expired",
                field="Authorization",
                remedy="ask the sender for a new one (POST /v1/shares, or scas4d scenes share)",
                headers={"WWW-Authenticate": 'Bearer realm="scas4d", error="invalid_token"'},
            )
        return Permission(scene=None if scene == ALL_SCENES else scene, end=int(end))
