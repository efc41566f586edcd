"""What every route reaches for."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends, Path, Request

from server.scene.scenes import Scene, Scenes
from server.settings import ServerSettings


def _scenes(request: Request) -> Scenes:
    scenes: Scenes = request.app.state.scenes
    return scenes


def _settings(request: Request) -> ServerSettings:
    settings: ServerSettings = request.app.state.settings
    return settings


def _scene(request: Request, id: Annotated[str, Path(max_length=64)]) -> Scene:
    return _scenes(request)[id]


AllScenes = Annotated[Scenes, Depends(_scenes)]
TheSettings = Annotated[ServerSettings, Depends(_settings)]
TheScene = Annotated[Scene, Depends(_scene)]
FrameIndex = Annotated[int, Path(ge=0, le=1_000_000_000)]
