"""Settings of the service: by argument, by environment (SCAS4D_<NAME>), by a TOML file (SCAS4D_CONFIG), by default.

The first of these that names a setting decides. docs/operations.md has the table of all, written from here.
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

    data: Path = Field(default=Path("data"), description="Folder of the scenes; made when missing.")

    host: str = Field(
        default="127.0.0.1", description="Address to listen at. Beyond the loopback only together with a token."
    )
    port: int = Field(default=8000, ge=0, le=65535, description="Port to listen at; 0 takes a free one.")
    token: SecretStr | None = Field(
        default=None,
        description="Every request but those of /health, the viewer's page and the API's description has to bear it "
        "(Authorization: Bearer). None: every user of this machine may do everything.",
    )
    token_file: Path | None = Field(
        default=None, description="File with the token, as a mounted secret; not together with `token`."
    )
    allowed_hosts: Names = Field(
        default=(),
        description="Names under which the service may be addressed (Host), besides those of the loopback and the "
        "address that it listens at: `studio.example`, or `studio.example:8443` for one port only. A name that is not "
        "here is refused: it may be an attacker's, pointed at this machine.",
    )
    allowed_origins: Names = Field(
        default=(),
        description="Other sites whose pages may use the service, as `https://viewer.example`; pages of the service "
        "itself always may.",
    )

    header_seconds: float = Field(
        default=10.0,
        gt=0,
        le=600,
        description="Time from the first byte of a request to the end of its header, and from opening a connection to "
        "that byte, in seconds; a later header gets 408, a connection without a byte is closed. A header is one or two "
        "packets: ten seconds allow to send them three times again.",
    )
    header_kb: int = Field(
        default=64,
        ge=8,
        le=1024,
        description="Largest header of a request, with its address, in kB of 1024 bytes; a larger one gets 431 or 414. "
        "Browsers send up to 16 kB with cookies of other services on this host; the time to read a header grows with "
        "the square of its size.",
    )
    body_seconds: float = Field(
        default=20.0,
        gt=0,
        le=3600,
        description="Time in which 16 kB of a body, or its end, have to come while the service reads, in seconds; else "
        "408. A radio link that is lost for a moment comes back sooner; 0.8 kB/s could not send a picture.",
    )
    keep_alive_seconds: float = Field(
        default=15.0,
        gt=0,
        le=3600,
        description="Life of a connection between two requests, in seconds. Longer than clients keep theirs (httpx 5 "
        "s), so that none sends into one that is just closed; a proxy has to close its idle connections sooner than "
        "this.",
    )
    unread_seconds: float = Field(
        default=30.0,
        gt=0,
        le=3600,
        description="Time in which a peer has to read 16 kB of the data that waits for it, in seconds; else the "
        "connection is ended, a WebSocket's too. That data is held in memory.",
    )
    max_connections: int = Field(
        default=1024,
        ge=8,
        description="Open connections, at most half of the files that may be open; a further one takes the place of "
        "one that has sent no whole header, is idle or has stopped sending, or gets 503.",
    )
    max_connections_per_peer: int = Field(
        default=256,
        ge=4,
        description="Open connections of one address, or of one client behind a trusted proxy: enough for 64 cameras "
        "with a sender each, and their viewers; more get 429.",
    )
    trusted_proxies: Names = Field(
        default=(),
        description="Addresses or networks (`10.0.0.2, 10.1.0.0/24`) of proxies whose X-Forwarded-For and "
        "X-Forwarded-Proto are believed, and whose connections are not counted as one peer's. Nobody else's are.",
    )

    log_format: Literal["auto", "json", "text"] = Field(
        default="auto",
        description="json: one object a line. text: plain lines, without requests that only read and succeed. auto: "
        "text where the service runs in a terminal, else json.",
    )
    log_level: Literal["debug", "info", "warning", "error"] = Field(
        default="info", description="info has a line a request."
    )

    placement: str = Field(
        default="local",
        description="Where processes of scenes run: `local`, on this machine; `ray`, on the Ray cluster that runs here "
        "or that RAY_ADDRESS names; `ray=HOST:6379`, on that one (docs/cluster.md).",
    )
    max_scenes: int = Field(
        default=8,
        ge=1,
        description="Scenes awake at a time, with up to three processes and some hundred megabytes each. Others sleep.",
    )
    sleep_seconds: float = Field(
        default=600.0,
        ge=0,
        description="A scene that nobody sends to or looks at sleeps after so long: its processes end, and start again "
        "when it is asked something. 0: never.",
    )
    max_scene_memory_mb: float | None = Field(
        default=None,
        gt=0,
        description="Memory of a scene in MB: one with a larger estimate (POST /v1/estimate) is refused. Default: "
        "the machine's memory.",
    )
    queue_frames: int = Field(
        default=4, ge=1, description="Frames of a scene acknowledged and not finished; more get 429."
    )
    max_body_mb: float = Field(
        default=256,
        gt=0,
        description="Largest request body: 64 cameras of 4 MB. One file, and a frame over a WebSocket, is "
        "limited by the rig's pictures where that is less.",
    )
    max_image_pixels: int = Field(
        default=40_000_000,
        ge=1,
        description="Pixels of one camera; a decoded picture takes 3 bytes a pixel, twice while decoding.",
    )
    max_subscribers: int = Field(default=128, ge=1, description="Subscribers of one scene's stream; more get 429.")
    scrub_mb_per_second: float = Field(
        default=4.0,
        ge=0,
        description="All that a scene has on disk is read again in the background and compared with its checksums, so "
        "fast for each scene, and at a quarter of that while a frame of it is at work; 0: never. 4 MB/s take half a "
        "percent of a core.",
    )
    scrub_pause_seconds: float = Field(
        default=600.0, gt=0, description="Before each such pass over a scene; a flipped bit is found a pass later."
    )
    warm_up: bool = Field(
        default=True,
        description="Compile the kernels at start where the cache lacks them, in processes beside; /health/ready waits "
        "for those of a first frame.",
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
                raise ValueError(f"a proxy is an address or a network, as 10.0.0.2 or 10.1.0.0/24 ({error})") from None
        return value

    @model_validator(mode="after")
    def _guarded(self) -> ServerSettings:
        if not re.fullmatch(r"local|ray(=\S+:\d+)?", self.placement):
            raise ValueError(f"placement is {self.placement!r}; give local, ray, or ray=HOST:PORT")
        if self.token is not None and self.token_file is not None:
            raise ValueError("token and token_file are two tokens; give one of them")
        if self.token_file is not None and not self.token_file.is_file():
            raise ValueError(f"token_file: there is no file {self.token_file}")
        secret = self.secret
        if secret is not None and not TOKEN.fullmatch(secret):
            raise ValueError(
                "the token has to be 16 to 512 of the characters A-Z a-z 0-9 . _ ~ + / = -; make one with: "
                'python -c "import secrets; print(secrets.token_urlsafe(32))"'
            )
        if secret is None and not is_loopback(self.host):
            raise ValueError(
                f"host {self.host} can be reached from other machines, and there is no token; set SCAS4D_TOKEN or "
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
