"""`scripts/bench`: the studies, each imported when it runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from studies import commands_frontier as bench_frontier
from studies import commands_processors as bench_processors

app = typer.Typer(no_args_is_help=True, help="Studies that measure the method.")
bench_frontier.register(app)
bench_processors.register(app)

Study = Annotated[Path, typer.Option(help="Folder of the study: rows, pictures, frames 0. Run again to go on.")]
Again = Annotated[bool, typer.Option("--again", help="Measure anew what is there already (kept frames 0 are used).")]
STUDY = Path("out/quality")


@app.command()
def quality(
    captures: Annotated[list[Path], typer.Argument(metavar="CAPTURE...", help="Folders with test cameras.")],
    out: Study = STUDY,
    preset: Annotated[
        list[str] | None, typer.Option(help="scas4d (the default), adaptive or dynamic3dgs; may be repeated.")
    ] = None,
    iterations: Annotated[
        list[int] | None, typer.Option(min=1, help="Of an update; the preset's when left out. May be repeated.")
    ] = None,
    seed: Annotated[
        list[int] | None, typer.Option(min=0, help="Of frame 0 and the updates, default 0. May be repeated.")
    ] = None,
    frames: Annotated[int | None, typer.Option(min=1, help="Only so many frames; 1 measures frame 0 alone.")] = None,
    device: Annotated[str | None, typer.Option(help="cpu or cuda; the preset's when left out.")] = None,
    masks: Annotated[bool, typer.Option(help="Give the method the masks; they measure in any case.")] = True,
    points: Annotated[bool, typer.Option(help="Give the method the initial cloud.")] = True,
    lpips: Annotated[bool, typer.Option("--lpips", help="Also LPIPS, where its weights are installed.")] = False,
    again: Again = False,
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="A setting, as update.clusters=[1280]. May be repeated."),
    ] = None,
) -> None:
    """Measures pictures, tracks, parts and seconds of captures; prints a table.

    Reconstructs every capture with every preset, number of iterations and seed, each row in a process of its own, and
    measures it on the capture's test cameras and ground truth. Rows on disk are not measured again. Leaves table.md,
    a JSON file a row, a line a frame, and pictures (truth | render | difference) in the study's folder.

    Example: scripts/bench quality captures/robot --preset scas4d --preset dynamic3dgs --iterations 100
    """
    from studies.quality.quality import run

    rows = run(
        captures,
        out,
        preset or ["scas4d"],
        iterations=iterations or (),
        seeds=seed or (0,),
        overrides=changes or (),
        device=device,
        frames=frames,
        masks=masks,
        points=points,
        lpips=lpips,
        again=again,
    )
    if any("error" in row for row in rows):
        raise typer.Exit(1)


@app.command()
def bars(
    captures: Annotated[Path, typer.Argument(metavar="CAPTURES", help="Folder that holds the captures' folders.")],
    out: Study = STUDY,
    run: Annotated[
        list[str] | None,
        typer.Option(help="Only this run, as scas4d, clusters-64 or dynamic3dgs-2000. May be repeated."),
    ] = None,
    only: Annotated[list[str] | None, typer.Option(help="Only this capture, by name. May be repeated.")] = None,
    frames: Annotated[int | None, typer.Option(min=1, help="Only so many frames; the table says how many.")] = None,
    again: Again = False,
) -> None:
    """Measures every row that the bars need, or some of them; `scripts/bench table` judges them.

    The costliest runs come last; dynamic3dgs-2000 takes 20 times as long as the others: --frames shortens it.
    """
    from studies.quality.runs import measure_runs

    rows = measure_runs(captures, out, run or (), only=only or (), frames=frames, again=again)
    if any("error" in row for row in rows):
        raise typer.Exit(1)


@app.command()
def table(
    study: Annotated[Path, typer.Argument(help="Folder of the study.")] = STUDY,
    out: Annotated[
        Path | None, typer.Option(help="Write the whole page here (commands, machine, bars, rows) as Markdown.")
    ] = None,
) -> None:
    """Prints which bars the measured rows reach, as one Markdown table.

    A row counts where its settings are exactly those of today's presets; of several, the one with most frames.
    """
    from studies.quality.targets import bar_table, count_words, judge, left_out, page, read_study

    if not study.is_dir():
        raise typer.BadParameter(f"{study} is no folder; measure first: scripts/bench bars CAPTURES --out {study}")
    rows = read_study(study)
    verdicts = judge(rows)
    print(bar_table(verdicts))
    print(f"\n{count_words(verdicts)}.")
    if others := left_out(study, rows):
        print(f"{others} rows of the study are not used: other settings than today's presets, or fewer frames.")
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(page(rows))


@app.command()
def kernels(
    capture: Annotated[Path, typer.Argument(metavar="CAPTURE", help="Folder of a capture; the bars are for robot.")],
    out: Annotated[Path | None, typer.Option(help="Write the page here, as Markdown.")] = None,
    store: Annotated[Path, typer.Option(help="Folder of the study, for `scripts/bench table`.")] = STUDY,
    preset: Annotated[str, typer.Option(help="Named settings.")] = "scas4d",
    frames: Annotated[int, typer.Option(min=3, help="Of the run that is timed; the first update does not count.")] = 8,
    repeats: Annotated[int, typer.Option(min=1, help="Of the rasterizer and of its arithmetic.")] = 9,
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="A setting, as update.clusters=[1280]. May be repeated."),
    ] = None,
) -> None:
    """Measures the CPU kernels: rasterizer against its arithmetic, update against its passes, peak memory.

    Leave the machine alone meanwhile; NUMBA_NUM_THREADS sets the threads. Frame 0 is fitted anew, for its memory.
    """
    from studies.kernels import kernels as of_kernels
    from studies.quality.job import settings_of

    settings = settings_of(preset, overrides=changes or ())
    row = of_kernels.study(capture, settings, store, frames=frames, repeats=repeats)
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(of_kernels.page(row))


@app.command()
def device(
    gaussians: Annotated[int, typer.Option(min=100, help="That move; a quarter as many stand.")] = 8000,
    size: Annotated[int, typer.Option(min=16, help="Pixels, side of the six pictures.")] = 384,
    iterations: Annotated[int, typer.Option(min=1, help="Of the update.")] = 20,
    repeats: Annotated[int, typer.Option(min=1, help="Of each stage, after a first call that compiles.")] = 5,
    out: Annotated[Path | None, typer.Option(help="Write the table here, as Markdown.")] = None,
) -> None:
    """Compares the GPU with the CPU stage by stage, on a scene made up for it; fails where they disagree."""
    from studies.kernels import device as of_device

    text, agree = of_device.run(gaussians=gaussians, size=size, iterations=iterations, repeats=repeats)
    typer.echo(text)
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(text + "\n")
    if not agree:
        raise typer.Exit(1)


@app.command()
def faults(
    capture: Annotated[Path, typer.Argument(metavar="CAPTURE", help="Folder of a capture; short ones are repeated.")],
    frames: Annotated[int, typer.Option(min=4, help="Sent in every scenario.")] = 20,
    kills: Annotated[int, typer.Option(min=0, help="kill -9 of the worker or the service, at random moments.")] = 30,
    cuts: Annotated[int, typer.Option(min=0, help="Files of the log that are cut.")] = 20,
    flips: Annotated[int, typer.Option(min=0, help="Files of the log in which a bit is flipped.")] = 1,
    bits: Annotated[
        int, typer.Option(min=0, help="Bits flipped one by one in states, checkpoints, journal and frames.")
    ] = 200,
    turns: Annotated[
        int, typer.Option(min=1, help="Without strangers and with them, each with a token and without.")
    ] = 3,
    part: Annotated[
        list[str] | None, typer.Option(help="Only this: kills, log, disk, bits or strangers. May be repeated.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the random moments and places.")] = 0,
    work: Annotated[Path, typer.Option(help="Folder for data folders and logs; what is there goes.")] = Path(
        "out/faults"
    ),
    out: Annotated[Path | None, typer.Option(help="Write the table here, as Markdown.")] = None,
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="A setting of the scene, as update.iterations=20."),
    ] = None,
) -> None:
    """Kills the service and its workers, cuts and damages its files, fills its disk; compares with an undisturbed run.

    Then strangers without a token hold it up: an endless header, half-sent headers, hanging uploads, during updates.

    Example: scripts/bench faults samples/robot --set static.iterations=300 --set update.iterations=20
    """
    from client.cli.extras import need_server
    from client.cli.overrides import overrides
    from scas4d_core.captures import open_capture
    from studies.service import faults as of_faults
    from studies.service.outcome import table
    from studies.service.study import Study, encoded_frames

    need_server()
    if unknown := set(part or []) - set(of_faults.PARTS):
        raise typer.BadParameter(f"there is no part {sorted(unknown)[0]!r}; the parts are {', '.join(of_faults.PARTS)}")
    opened = open_capture(capture)
    study = Study(
        work.resolve(),
        opened,
        encoded_frames(opened, frames),
        overrides(changes or []),
        {},
    )
    parts = part or of_faults.PARTS
    outcomes = of_faults.run(
        study, moments=kills, cuts=cuts, flips=flips, bits=bits, seed=seed, turns=turns, parts=parts, told=typer.echo
    )
    text = table(outcomes)
    typer.echo(text)
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(text + "\n")
    if not all(outcome.reached for outcome in outcomes):
        raise typer.Exit(1)


@app.command()
def ingest(
    frames: Annotated[int, typer.Option(min=1, help="A round.")] = 20,
    cameras: Annotated[int, typer.Option(min=1, help="Of the rig.")] = 27,
    megabytes: Annotated[float, typer.Option(min=0.01, help="Of one JPEG.")] = 1.0,
    rounds: Annotated[int, typer.Option(min=1, help="Each measures both ways.")] = 5,
    senders: Annotated[int, typer.Option(min=1, help="Connections of the one sending process.")] = 2,
    work: Annotated[Path, typer.Option(help="Folder on the disk that is measured.")] = Path("out/ingest"),
    out: Annotated[Path | None, typer.Option(help="Write the table here, as Markdown.")] = None,
) -> None:
    """Measures ingest over the loopback against plain fsynced writes of the same records, in turns."""
    from client.cli.extras import need_server
    from studies.service import ingest as of_ingest

    need_server()

    size = int(megabytes * 1e6)
    measured = of_ingest.measure(
        work.resolve(), frames=frames, cameras=cameras, size_bytes=size, rounds=rounds, senders=senders
    )
    text = of_ingest.page(measured, frames=frames, cameras=cameras, size_bytes=size, senders=senders)
    typer.echo(text)
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(text + "\n")


@app.command()
def views(
    capture: Annotated[Path, typer.Argument(metavar="CAPTURE", help="Folder of a capture; short ones are repeated.")],
    rate: Annotated[
        list[float] | None, typer.Option(min=0.1, help="Views a second, default 1, 5 and 20. May be repeated.")
    ] = None,
    updates: Annotated[int, typer.Option(min=1, help="A turn, without views and with.")] = 8,
    turns: Annotated[int, typer.Option(min=1, help="Of each rate.")] = 3,
    width: Annotated[int, typer.Option(min=1, help="Of a view, in pixels.")] = 256,
    work: Annotated[Path, typer.Option(help="Folder for the service's data; what is there goes.")] = Path("out/views"),
    out: Annotated[Path | None, typer.Option(help="Write the table here, as Markdown.")] = None,
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="A setting of the scene, as static.iterations=500."),
    ] = None,
) -> None:
    """Measures live views beside updates: latency under an open-loop load, and what it costs the updates.

    Example: scripts/bench views captures/robot
    """
    from client.cli.extras import need_server
    from client.cli.overrides import overrides
    from scas4d_core.captures import open_capture
    from studies.service import views as of_views

    need_server()
    rows = of_views.measure(
        open_capture(capture),
        work.resolve(),
        rates=rate or (1, 5, 20),
        updates=updates,
        turns=turns,
        width=width,
        settings=overrides(changes or []),
        environment={},
        told=typer.echo,
    )
    text = of_views.page(rows, capture.name, width, updates, turns)
    typer.echo(text)
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(text)


@app.command()
def stability(
    cases: Annotated[
        list[str] | None, typer.Option(help="Only cases whose name holds this. May be repeated.", show_default=False)
    ] = None,
    fast: Annotated[bool, typer.Option("--fast", help="Leave out what takes long, as a million to cluster.")] = False,
    mutate: Annotated[
        bool, typer.Option("--mutate", help="Take away each guard in turn; goes on where it was interrupted.")
    ] = False,
    store: Annotated[Path, typer.Option(help="Folder of the mutations' results.")] = Path("out/stability"),
    out: Annotated[Path | None, typer.Option(help="Write the tables here, between their marks.")] = None,
    frames: Annotated[
        bool,
        typer.Option("--frames", help="The frame cases instead, and what the checks cost; made up, or --captures."),
    ] = False,
    captures: Annotated[
        list[Path] | None, typer.Option(help="Frame cases on this capture with test cameras. May be repeated.")
    ] = None,
    service: Annotated[
        bool, typer.Option("--service", help="The frame cases through a running service instead.")
    ] = False,
    soak: Annotated[
        int | None, typer.Option(min=1, help="So many frames of a small scene instead; goes on where it was.")
    ] = None,
) -> None:
    """Runs the catalogue of hard cases on every backend that is here, and counts what the guards did.

    Examples: scripts/bench stability --cases NaN --cases fold; scripts/bench stability --captures captures/robot;
    scripts/bench stability --service; scripts/bench stability --soak 10000
    """
    if frames or captures or service or soak is not None:
        from studies.commands_stability import frame_studies

        frame_studies(captures or [], store, cases or [], service=service, soak=soak)
        return
    from studies.hard_cases import mutate as mutations
    from studies.hard_cases import run

    lines = run.run(cases, slow=not fast, told=typer.echo)
    failing = mutations.study(store, typer.echo) if mutate else mutations.known(store)
    if out is not None:
        if cases or fast:
            raise typer.BadParameter("a page has all cases; leave out --cases and --fast, or --out")
        run.write_page(out, run.page(lines, failing, *run.here()))
    if any(line.violations for line in lines) or (mutate and not all((failing or {}).values())):
        raise typer.Exit(1)
