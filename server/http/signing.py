"""Signing of short texts with the service's token.

Every service with the same token can verify a signed text. Nothing is stored, so changing the token invalidates all
signatures.
"""

from __future__ import annotations

import base64
import hashlib
import hmac


class Signer:
    """Signer and verifier of texts, using HMAC-SHA256.

    Args:
        secret: the service's token.
        purpose: purpose of the signatures; a signature for one purpose is invalid for any other.

    >>> signer = Signer("a-token-of-the-service", "an example")
    >>> signer.read(signer.sign("a.b"))
    'a.b'
    >>> signer.read("a.b.made-up") is None
    True
    """

    def __init__(self, secret: str, purpose: str) -> None:
        self._key = hmac.digest(secret.encode(), purpose.encode(), hashlib.sha256)

    def sign(self, text: str) -> str:
        """Returns the text followed by a dot and its signature."""
        return f"{text}.{self._signature(text)}"

    def read(self, signed: str) -> str | None:
        """Returns the text without its signature, or None if the signature is invalid."""
        text, _, signature = signed.encode("utf-8", "replace").decode().rpartition(".")
        return text if hmac.compare_digest(signature.encode(), self._signature(text).encode()) else None

    def _signature(self, text: str) -> str:
        return base64.urlsafe_b64encode(hmac.digest(self._key, text.encode(), hashlib.sha256)).decode().rstrip("=")
