"""Settings of the service, from arguments, the environment (SCAS4D_<NAME>), a TOML file (SCAS4D_CONFIG) and defaults.

Earlier sources take precedence. docs/service-settings.md contains a table generated from this module.
"""

from __future__ import annotations

import ipaddress
import os
import re
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, SecretStr, ValidationError, field_validator, model_validator
from pydantic_settings import (
    BaseSettings,
    EnvSettingsSource,
    NoDecode,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
    TomlConfigSettingsSource,
)

from scas4d_core.engines.choose import WARP_DEVICE

PREFIX = "SCAS4D_"
CONFIG = "SCAS4D_CONFIG"
"""Environment variable with the path of the TOML file; not a setting itself."""
URL = "SCAS4D_URL"
"""Environment variable with the service's URL for clients; it may also be set in the service's environment."""

TOKEN = re.compile(r"[A-Za-z0-9._~+/=-]{16,512}")
"""Pattern of tokens that are valid in `Authorization: Bearer` (RFC 6750) and too long to guess."""

Names = Annotated[tuple[str, ...], NoDecode]
"""List of names, comma-separated in the environment."""


class SettingsError(ValueError):
    """Error for an invalid setting; the message contains its name, a remedy and, if it cannot be secret, its value."""


class ServerSettings(BaseSettings):
    """Settings of the service, chosen by its operator."""

    model_config = SettingsConfigDict(
        frozen=True, extra="forbid", use_attribute_docstrings=True, hide_input_in_errors=True, env_prefix=PREFIX
    )

    data: Path = Path("data")
    """Data folder for the scenes; created if missing."""

    host: str = "127.0.0.1"
    """Address to listen on. Any address other than loopback requires a token."""
    port: int = Field(default=8000, ge=0, le=65535)
    """Port to listen on; 0 selects any free port."""
    token: SecretStr | None = None
    """Token that every request must send (Authorization: Bearer), except requests for /health, the viewer's files and
    the API description. Without a token, every user of this machine has full access.
    """
    token_file: Path | None = None
    """File that contains the token, such as a mounted secret; conflicts with `token`."""
    allowed_hosts: Names = ()
    """Additional host names of the service: `studio.example`, or `studio.example:8443` for one port. Requests for other
    names are refused, to prevent DNS rebinding.
    """
    allowed_origins: Names = ()
    """Origins of other sites whose pages may use the service, such as `https://viewer.example`."""

    header_seconds: float = Field(default=10.0, gt=0, le=600)
    """Time limit in seconds for sending a header, from the opening of the connection or the first byte of a later
    request.
    """
    header_kb: int = Field(default=64, ge=8, le=1024)
    """Maximum size of a header including the URL, in units of 1024 bytes."""
    body_seconds: float = Field(default=20.0, gt=0, le=3600)
    """Time limit in seconds for every 16 kB of a request body, or for the remainder if it is shorter."""
    keep_alive_seconds: float = Field(default=15.0, gt=0, le=3600)
    """Time in seconds after which an idle connection is closed. Clients and proxies should close theirs earlier (httpx:
    5 s).
    """
    unread_seconds: float = Field(default=30.0, gt=0, le=3600)
    """Time limit in seconds for a peer to read 16 kB of pending data; after that, its connection is aborted."""
    max_connections: int = Field(default=1024, ge=8)
    """Maximum number of open connections, reduced to half of the limit on open files if that is lower."""
    max_connections_per_peer: int = Field(default=256, ge=4)
    """Maximum number of open connections per address, or per client of a trusted proxy. The default is enough for 64
    cameras with one sender each, plus viewers.
    """
    trusted_proxies: Names = ()
    """Addresses or networks (`10.0.0.2, 10.1.0.0/24`) of proxies whose X-Forwarded-For and X-Forwarded-Proto are
    trusted.
    """

    log_format: Literal["auto", "json", "text"] = "auto"
    """Log format: json (one object per line), text (plain lines, without successful reads) or auto (text in a terminal,
    otherwise json).
    """
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    """Minimum log level; info logs one line per request."""

    placement: str = "local"
    """Where the scenes' processes run: `local` (this machine), `ray` (the local Ray cluster, or the one in RAY_ADDRESS)
    or `ray=HOST:6379` (the cluster at that address; see docs/cluster.md).
    """
    max_scenes: int = Field(default=8, ge=1)
    """Maximum number of awake scenes, each with up to three processes; others are asleep."""
    sleep_seconds: float = Field(default=600.0, ge=0)
    """Time in seconds after which an unused scene falls asleep; 0 disables sleep."""
    max_scene_memory_mb: float | None = Field(default=None, gt=0)
    """Maximum estimated memory of a scene, in MB; larger scenes are refused. Defaults to the machine's memory."""
    queue_frames: int = Field(default=4, ge=1)
    """Maximum number of acknowledged but unfinished frames per scene; further frames are refused (429). At least 8 in
    scenes that skip frames.
    """
    max_body_mb: float = Field(default=256, gt=0)
    """Maximum size of a request body, in MB. The default allows 64 cameras with 4 MB each. Files and WebSocket messages
    have smaller limits that depend on the rig.
    """
    max_image_pixels: int = Field(default=40_000_000, ge=1)
    """Maximum number of pixels per camera. An image takes 3 bytes per pixel, and 6 during decoding."""
    max_subscribers: int = Field(default=128, ge=1)
    """Maximum number of subscribers per scene; further ones are refused (429)."""
    scrub_mb_per_second: float = Field(default=4.0, ge=0)
    """Rate at which each scene's files are reread to verify checksums, reduced to a quarter during updates. 0 disables
    the check. Reading 4 MB/s takes half a percent of a core.
    """
    scrub_pause_seconds: float = Field(default=600.0, gt=0)
    """Pause in seconds between scrub passes over a scene."""
    warm_up: bool = True
    """Whether to compile missing kernels at startup, in separate processes. /health/ready waits for the kernels needed
    for a first frame.
    """

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Restricts the constructor to its arguments; `from_environment` reads the environment and the file."""
        return (init_settings,)

    @field_validator("allowed_hosts", "allowed_origins", "trusted_proxies", mode="before")
    @classmethod
    def _split(cls, value: Any) -> Any:
        return tuple(name.strip() for name in value.split(",") if name.strip()) if isinstance(value, str) else value

    @field_validator("allowed_origins")
    @classmethod
    def _origins(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for origin in value:
            if not re.fullmatch(r"https?://[^/\s]+", origin):
                raise ValueError("an origin must be scheme://host or scheme://host:port, without a path")
        return value

    @field_validator("trusted_proxies")
    @classmethod
    def _networks(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for network in value:
            try:
                ipaddress.ip_network(network)
            except ValueError as error:
                raise ValueError(
                    f"a proxy must be an address or a network, such as 10.0.0.2 or 10.1.0.0/24 ({error})"
                ) from None
        return value

    @model_validator(mode="after")
    def _guarded(self) -> ServerSettings:
        if not re.fullmatch(r"local|ray(=\S+:\d+)?", self.placement):
            raise ValueError(f"placement must be local, ray or ray=HOST:PORT; got {self.placement!r}")
        if self.token is not None and self.token_file is not None:
            raise ValueError("token and token_file are both set; set only one")
        if self.token_file is not None and not self.token_file.is_file():
            raise ValueError(f"token_file: file {self.token_file} does not exist")
        secret = self.secret
        if secret is not None and not TOKEN.fullmatch(secret):
            raise ValueError(
                "the token must consist of 16 to 512 characters from A-Z a-z 0-9 . _ ~ + / = -; generate one with: "
                'python -c "import secrets; print(secrets.token_urlsafe(32))"'
            )
        if secret is None and not is_loopback(self.host):
            raise ValueError(
                f"host {self.host} is reachable from other machines, but no token is set; set SCAS4D_TOKEN or "
                "SCAS4D_TOKEN_FILE, or listen on 127.0.0.1"
            )
        return self

    @property
    def secret(self) -> str | None:
        """Token in plain text, from `token` or `token_file`; None if neither is set."""
        if self.token_file is not None:
            return self.token_file.read_text(encoding="utf-8", errors="replace").strip()
        return None if self.token is None else self.token.get_secret_value()

    @classmethod
    def from_environment(cls, environment: Mapping[str, str] | None = None, **given: object) -> ServerSettings:
        """Returns the defaults, overridden in turn by the file, the environment, and arguments other than None.

        Raises:
            SettingsError: a setting is invalid; the message includes its name and the remedy.
        """
        environment = os.environ if environment is None else environment
        source = EnvSettingsSource(cls)
        source.env_vars = {name.lower(): value for name, value in environment.items()}
        read = source()
        file = environment.get(CONFIG)
        if file is not None and not Path(file).is_file():
            raise SettingsError(f"{CONFIG}: file {file} does not exist; set it to the path of a TOML file")
        try:
            written = {} if file is None else TomlConfigSettingsSource(cls, toml_file=Path(file))()
        except ValueError as error:  # tomllib's message has the line and column
            raise SettingsError(f"{CONFIG}: {file} is not valid TOML ({error})") from None
        merged = {**written, **read, **{n: v for n, v in given.items() if v is not None}}
        try:
            return cls.model_validate(merged)
        except ValidationError as error:
            first = error.errors(include_input=False)[0]
            name = ".".join(str(part) for part in first["loc"])
            known = (
                "" if first["type"] != "extra_forbidden" else f"; the valid settings are {', '.join(cls.model_fields)}"
            )
            ours = first["type"] == "value_error"
            fault = str(first["ctx"]["error"] if ours else first["msg"])
            quotable = name in cls.model_fields and name != "token"
            value = f" has the invalid value {merged[name]!r}" if quotable and name in merged else ""
            raise SettingsError((f"setting {name}{value}: " if name else "") + fault + known) from None


def unknown_names(environment: Mapping[str, str]) -> list[str]:
    """Returns the names that look like settings but are unknown, most likely because they are misspelled."""
    known = {f"{PREFIX}{name.upper()}" for name in ServerSettings.model_fields} | {CONFIG, URL, WARP_DEVICE}
    return sorted(name for name in environment if name.upper().startswith(PREFIX) and name.upper() not in known)


@lru_cache(64)
def is_loopback(host: str) -> bool:
    """Returns whether the address is a loopback address. Cached, because every request checks the same few hosts."""
    try:
        return host.lower() == "localhost" or ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False
