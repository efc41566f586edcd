"""The commands `scas4d scenes …`, which list, rename, pause, archive, put to sleep, share and delete scenes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated

import typer

from client.progress import console
from client.sdk import DEFAULT_URL, Client
from client.wire import Retention, SceneStatus

Url = Annotated[str, typer.Option(envvar="SCAS4D_URL", help="Service URL.")]
Token = Annotated[
    str | None,
    typer.Option(envvar="SCAS4D_TOKEN", help="Access token; prefer the environment variable SCAS4D_TOKEN."),
]
Scene = Annotated[str, typer.Argument(metavar="SCENE", help="Scene id.")]
Scenes = Annotated[list[str], typer.Argument(metavar="SCENE...", help="Scene ids.")]

app = typer.Typer(help="Lists and manages the service's scenes.", invoke_without_command=True)


HEAD = ("scene", "name", "state", "cameras", "next frame", "queued", "committed", "awake", "error")


def table(statuses: Sequence[SceneStatus]) -> list[str]:
    """Formats scenes as the lines of a table with a header.

    Cells are never truncated to the terminal width, because scripts parse these lines too.
    """
    rows: list[tuple[str, ...]] = [HEAD]
    for status in statuses:
        awake = "archived" if status.archived else "asleep" if status.asleep else "yes"
        numbers = (len(status.cameras), status.next_frame, status.queued, status.committed)
        rows.append((status.id, status.name, status.state, *map(str, numbers), awake, status.error or ""))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(word.ljust(width) for word, width in zip(row, widths, strict=True)).rstrip() for row in rows]


@app.callback()
def listed(
    context: typer.Context,
    url: Url = DEFAULT_URL,
    token: Token = None,
    all: Annotated[bool, typer.Option("--all", help="Include archived scenes.")] = False,
) -> None:
    """Lists the service's scenes, oldest first. Other commands take the id shown here as SCENE."""
    if context.invoked_subcommand is not None:
        return
    with Client(url, token=token, outage=0) as client:
        summaries = client.scenes()
    shown = [status for status in summaries if all or not status.archived]
    _say(*table(shown))
    if hidden := len(summaries) - len(shown):
        _say(f"{hidden} archived; to include them: scas4d scenes --all")
    if not summaries:
        _say("no scenes yet; create one with: scas4d push CAPTURE")


@app.command()
def rename(
    scene: Scene,
    name: Annotated[str, typer.Argument(metavar="NAME", help="New name; the id does not change.")],
    url: Url = DEFAULT_URL,
    token: Token = None,
) -> None:
    """Renames a scene."""
    with Client(url, token=token) as client:
        _print_status(client.edit_scene(scene, name=name))


@app.command()
def pause(scenes: Scenes, url: Url = DEFAULT_URL, token: Token = None) -> None:
    """Pauses scenes after the current frame: they still accept frames, but do not reconstruct them."""
    _change(scenes, url, token, lambda client, scene: client.pause(scene))


@app.command()
def resume(scenes: Scenes, url: Url = DEFAULT_URL, token: Token = None) -> None:
    """Resumes paused scenes."""
    _change(scenes, url, token, lambda client, scene: client.resume(scene))


@app.command()
def archive(scenes: Scenes, url: Url = DEFAULT_URL, token: Token = None) -> None:
    """Archives scenes: they accept no frames, sleep unless someone views them, and are listed only with --all."""
    _change(scenes, url, token, lambda client, scene: client.edit_scene(scene, archived=True))


@app.command()
def restore(scenes: Scenes, url: Url = DEFAULT_URL, token: Token = None) -> None:
    """Restores archived scenes."""
    _change(scenes, url, token, lambda client, scene: client.edit_scene(scene, archived=False))


@app.command()
def keep(
    scene: Scene,
    frames: Annotated[
        str | None,
        typer.Option(metavar="COUNT|all", help="Number of newest frames whose images to keep, or all."),
    ] = None,
    minutes: Annotated[
        float | None,
        typer.Option(
            min=0.1, help="Maximum age of images in minutes; without --frames, the only limit. Omit for no maximum."
        ),
    ] = None,
    states: Annotated[
        str | None,
        typer.Option(
            metavar="COUNT|all",
            help="Number of newest committed states to keep, or all; the others are permanently deleted.",
        ),
    ] = None,
    exact: Annotated[
        int | None,
        typer.Option(
            min=24,
            metavar="COUNT",
            help="Number of newest states to store exactly; older ones are moved to compact files.",
        ),
    ] = None,
    url: Url = DEFAULT_URL,
    token: Token = None,
) -> None:
    """Changes how many images and committed states a scene keeps; takes effect immediately."""
    kept_frames, kept_states = _rule("--frames", frames), _rule("--states", states)
    if minutes is not None:
        kept_frames = (kept_frames or Retention()).model_copy(update={"seconds": 60 * minutes})
    with Client(url, token=token) as client:
        _print_status(client.edit_scene(scene, keep_frames=kept_frames, keep_states=kept_states, exact_states=exact))


@app.command()
def sleep(scenes: Scenes, url: Url = DEFAULT_URL, token: Token = None) -> None:
    """Stops the processes of idle scenes now; a scene wakes up on the next request or frame."""
    _change(scenes, url, token, lambda client, scene: client.put_to_sleep(scene))


@app.command()
def share(
    scene: Annotated[str, typer.Argument(metavar="SCENE", help="Scene id, or all.")],
    hours: Annotated[float, typer.Option(min=0.01, max=87_840, help="Link lifetime in hours.")] = 168,
    only_token: Annotated[bool, typer.Option("--only-token", help="Print only the token, for use in scripts.")] = False,
    url: Url = DEFAULT_URL,
    token: Token = None,
) -> None:
    """Prints a read-only link to a scene; links cannot be revoked."""
    with Client(url, token=token) as client:
        made = client.share(None if scene == "all" else scene, round(3600 * hours))
    _say(made.token) if only_token else _say(url.rstrip("/") + made.address, f"valid until {made.ends}")


@app.command()
def delete(
    scenes: Scenes,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask for confirmation.")] = False,
    url: Url = DEFAULT_URL,
    token: Token = None,
) -> None:
    """Permanently deletes scenes and all their data on disk."""
    with Client(url, token=token) as client:
        for status in [client.scene(scene) for scene in scenes]:
            named = f"scene {status.id}" + (f" ({status.name})" if status.name else "")
            if not yes:
                typer.confirm(f"delete {named} and its {status.committed} committed frames?", abort=True)
            client.delete_scene(status.id)
            _say(f"deleted {named}")


def _rule(option: str, given: str | None) -> Retention | None:
    if given is None or given == "all":
        return None if given is None else Retention()
    if not given.isdecimal():
        raise ValueError(f"{option} must be a number of frames or all, such as {option} 100; got {given!r}")
    return Retention(last=int(given))


def _change(scenes: Sequence[str], url: str, token: str | None, call: Callable[[Client, str], SceneStatus]) -> None:
    with Client(url, token=token) as client:
        for scene in scenes:
            _print_status(call(client, scene))


def _print_status(status: SceneStatus) -> None:
    _say(*table([status]))


def _say(*lines: str) -> None:
    for line in lines:
        console.print(line, highlight=False, markup=False, soft_wrap=True)
