"""Settings of the service: by argument, by environment (SCAS4D_<NAME>), by a TOML file (SCAS4D_CONFIG), by default.

The first of these that names a setting decides. docs/service-settings.md has the table, generated from here.
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

PREFIX = "SCAS4D_"
CONFIG = "SCAS4D_CONFIG"
"""Names the TOML file; no setting itself."""
URL = "SCAS4D_URL"
"""The address of the service for clients; it may be set for both."""

TOKEN = re.compile(r"[A-Za-z0-9._~+/=-]{16,512}")
"""Tokens that fit behind `Authorization: Bearer` (RFC 6750) and are too long to be guessed."""

Names = Annotated[tuple[str, ...], NoDecode]
"""Several names; in the environment with commas between."""


class SettingsError(ValueError):
    """A setting is refused: the text has its name, the remedy, and its value unless that may be a secret."""


class ServerSettings(BaseSettings):
    """The settings of an operator."""

    model_config = SettingsConfigDict(frozen=True, extra="forbid", hide_input_in_errors=True, env_prefix=PREFIX)

    data: Path = Field(default=Path("data"), description="Folder of the scenes; created if missing.")

    host: str = Field(default="127.0.0.1", description="Address to listen at. Any but loopback needs a token.")
    port: int = Field(default=8000, ge=0, le=65535, description="Port to listen at; 0: any free port.")
    token: SecretStr | None = Field(
        default=None,
        description=(
            "Token that every request must send (Authorization: Bearer), except for /health, the viewer's "
            "files and the API description. None: every user of this machine has full access."
        ),
    )
    token_file: Path | None = Field(
        default=None, description="File with the token, such as a mounted secret; not together with `token`."
    )
    allowed_hosts: Names = Field(
        default=(),
        description=(
            "Further names of the service (Host): `studio.example`, or `studio.example:8443` for one "
            "port. Other names are refused, because they may be an attacker's."
        ),
    )
    allowed_origins: Names = Field(
        default=(),
        description="Other sites whose pages may use the service, such as `https://viewer.example`.",
    )

    header_seconds: float = Field(
        default=10.0,
        gt=0,
        le=600,
        description=(
            "Seconds to send a header, from opening the connection or from the first byte of a later request."
        ),
    )
    header_kb: int = Field(
        default=64,
        ge=8,
        le=1024,
        description="Largest header with its URL, in kB of 1024 bytes.",
    )
    body_seconds: float = Field(
        default=20.0,
        gt=0,
        le=3600,
        description="Seconds per 16 kB of a body, or until its end.",
    )
    keep_alive_seconds: float = Field(
        default=15.0,
        gt=0,
        le=3600,
        description=(
            "Lifetime of an idle connection in seconds. Clients should close earlier (httpx: 5 s), "
            "and so should proxies."
        ),
    )
    unread_seconds: float = Field(
        default=30.0,
        gt=0,
        le=3600,
        description=("Seconds in which a peer must read 16 kB of waiting data; otherwise the connection is aborted."),
    )
    max_connections: int = Field(
        default=1024,
        ge=8,
        description="Open connections in total, at most half of the open files allowed.",
    )
    max_connections_per_peer: int = Field(
        default=256,
        ge=4,
        description=(
            "Open connections per address, or per client of a trusted proxy: enough for 64 cameras "
            "with a sender each, and their viewers."
        ),
    )
    trusted_proxies: Names = Field(
        default=(),
        description=(
            "Addresses or networks (`10.0.0.2, 10.1.0.0/24`) of proxies whose X-Forwarded-For and "
            "X-Forwarded-Proto are trusted."
        ),
    )

    log_format: Literal["auto", "json", "text"] = Field(
        default="auto",
        description=(
            "json: one object per line. text: plain lines, without successful reads. auto: text in a "
            "terminal, else json."
        ),
    )
    log_level: Literal["debug", "info", "warning", "error"] = Field(
        default="info", description="Minimum level. info logs a line per request."
    )

    placement: str = Field(
        default="local",
        description=(
            "`local`: processes of scenes run on this machine. `ray`: on the local Ray cluster, or "
            "the one in RAY_ADDRESS. `ray=HOST:6379`: on that cluster (docs/cluster.md)."
        ),
    )
    max_scenes: int = Field(
        default=8,
        ge=1,
        description="Maximum number of awake scenes, with up to three processes each. The others sleep.",
    )
    sleep_seconds: float = Field(
        default=600.0,
        ge=0,
        description="An unused scene sleeps after this many seconds. 0: never.",
    )
    max_scene_memory_mb: float | None = Field(
        default=None,
        gt=0,
        description="Refuse scenes with a larger memory estimate, in MB. Default: the machine's memory.",
    )
    queue_frames: int = Field(
        default=4, ge=1, description="Acknowledged, unfinished frames per scene; further frames get 429."
    )
    max_body_mb: float = Field(
        default=256,
        gt=0,
        description=(
            "Largest request body: 64 cameras of 4 MB. Files and WebSocket messages have smaller "
            "limits that depend on the rig."
        ),
    )
    max_image_pixels: int = Field(
        default=40_000_000,
        ge=1,
        description="Pixels of one camera. A decoded picture takes 3 bytes per pixel, twice while decoding.",
    )
    max_subscribers: int = Field(
        default=128, ge=1, description="Subscribers of one scene's stream; further ones get 429."
    )
    scrub_mb_per_second: float = Field(
        default=4.0,
        ge=0,
        description=(
            "Rate at which each scene's files are read again and their checksums verified; a quarter "
            "of it during an update. 0: never. 4 MB/s take half a percent of a core."
        ),
    )
    scrub_pause_seconds: float = Field(default=600.0, gt=0, description="Pause between two passes over a scene.")
    warm_up: bool = Field(
        default=True,
        description=(
            "Compile missing kernels at start, in other processes; /health/ready waits for those of a first frame."
        ),
    )

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Keeps the constructor to its arguments; `from_environment` reads the environment and the file."""
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
                raise ValueError("an origin is scheme://host or scheme://host:port, without a path")
        return value

    @field_validator("trusted_proxies")
    @classmethod
    def _networks(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for network in value:
            try:
                ipaddress.ip_network(network)
            except ValueError as error:
                raise ValueError(
                    f"a proxy is an address or a network, such as 10.0.0.2 or 10.1.0.0/24 ({error})"
                ) from None
        return value

    @model_validator(mode="after")
    def _guarded(self) -> ServerSettings:
        if not re.fullmatch(r"local|ray(=\S+:\d+)?", self.placement):
            raise ValueError(f"placement is {self.placement!r}; give local, ray, or ray=HOST:PORT")
        if self.token is not None and self.token_file is not None:
            raise ValueError("token and token_file are both set; give only one")
        if self.token_file is not None and not self.token_file.is_file():
            raise ValueError(f"token_file: there is no file {self.token_file}")
        secret = self.secret
        if secret is not None and not TOKEN.fullmatch(secret):
            raise ValueError(
                "the token must consist of 16 to 512 of the characters A-Z a-z 0-9 . _ ~ + / = -; make one with: "
                'python -c "import secrets; print(secrets.token_urlsafe(32))"'
            )
        if secret is None and not is_loopback(self.host):
            raise ValueError(
                f"host {self.host} is reachable from other machines, and there is no token; set SCAS4D_TOKEN or "
                "SCAS4D_TOKEN_FILE, or listen at 127.0.0.1"
            )
        return self

    @property
    def secret(self) -> str | None:
        """The token itself."""
        if self.token_file is not None:
            return self.token_file.read_text(encoding="utf-8", errors="replace").strip()
        return None if self.token is None else self.token.get_secret_value()

    @classmethod
    def from_environment(cls, environment: Mapping[str, str] | None = None, **given: object) -> ServerSettings:
        """Reads the settings: defaults, overridden by the file, the environment and arguments that are not None.

        Raises:
            SettingsError: names the setting and what to do.
        """
        environment = os.environ if environment is None else environment
        source = EnvSettingsSource(cls)
        source.env_vars = {name.lower(): value for name, value in environment.items()}
        read = source()
        file = environment.get(CONFIG)
        if file is not None and not Path(file).is_file():
            raise SettingsError(f"{CONFIG}: there is no file {file}; name a TOML file")
        try:
            written = {} if file is None else TomlConfigSettingsSource(cls, toml_file=Path(file))()
        except ValueError as error:  # tomllib's says line and column
            raise SettingsError(f"{CONFIG}: {file} is not valid TOML ({error})") from None
        merged = {**written, **read, **{n: v for n, v in given.items() if v is not None}}
        try:
            return cls.model_validate(merged)
        except ValidationError as error:
            first = error.errors(include_input=False)[0]
            name = ".".join(str(part) for part in first["loc"])
            known = "" if first["type"] != "extra_forbidden" else f"; the settings are {', '.join(cls.model_fields)}"
            ours = first["type"] == "value_error"
            fault = str(first["ctx"]["error"] if ours else first["msg"])
            quotable = name in cls.model_fields and name != "token"
            value = f" is {merged[name]!r}, which cannot be" if quotable and name in merged else ""
            raise SettingsError((f"setting {name}{value}: " if name else "") + fault + known) from None


def unknown_names(environment: Mapping[str, str]) -> list[str]:
    """Returns names that look like settings and are none: misspelt, most likely."""
    known = {f"{PREFIX}{name.upper()}" for name in ServerSettings.model_fields} | {CONFIG, URL}
    return sorted(name for name in environment if name.upper().startswith(PREFIX) and name.upper() not in known)


@lru_cache(64)
def is_loopback(host: str) -> bool:
    """Returns True if only this machine reaches the address. Cached: every request asks for the same few."""
    try:
        return host.lower() == "localhost" or ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False
