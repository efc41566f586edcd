"""Signs short texts with the token of the service: what it handed out is known again, by every service of that token.

Nothing is kept: another token ends all that was signed.
"""

from __future__ import annotations

import base64
import hashlib
import hmac


class Signer:
    """Signs by HMAC-SHA256.

    Args:
        secret: the token of the service. purpose: what is signed for one is no proof for another, nor of the token.

    >>> signer = Signer("a-token-of-the-service", "an example")
    >>> signer.read(signer.sign("a.b"))
    'a.b'
    >>> signer.read("a.b.made-up") is None
    True
    """

    def __init__(self, secret: str, purpose: str) -> None:
        self._key = hmac.digest(secret.encode(), purpose.encode(), hashlib.sha256)

    def sign(self, text: str) -> str:
        """Appends the signature, after a dot."""
        return f"{text}.{self._signature(text)}"

    def read(self, signed: str) -> str | None:
        """Returns the text; None where it was not signed by this token for this purpose."""
        text, _, signature = signed.encode("utf-8", "replace").decode().rpartition(".")
        return text if hmac.compare_digest(signature.encode(), self._signature(text).encode()) else None

    def _signature(self, text: str) -> str:
        return base64.urlsafe_b64encode(hmac.digest(self._key, text.encode(), hashlib.sha256)).decode().rstrip("=")
