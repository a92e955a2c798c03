"""The command line: ``splatpipe COMMAND``.

An error is one line on standard error and an exit status: 2 for bad usage, configuration or input, 1 for a failure
while running; ``--debug`` shows the traceback. Commands import what they need when they run.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from ..shared.byte_size import parse_bytes
from ..shared.compile_cache import ensure_compile_cache
from ..shared.errors import InputError, SplatpipeError
from ..shared.files import DISK_FULL
from .layers import layer_app

app = typer.Typer(
    name="splatpipe",
    help="Point-cloud pictures and flythroughs from machines without a screen.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)
bench_app = typer.Typer(help="Measure this machine: rasterizers and the builder, beside others in the same run.")
app.add_typer(bench_app, name="bench")
app.add_typer(layer_app, name="layer")

CellInputs = Annotated[
    list[str] | None, typer.Argument(help="Scenes, point files, folders or globs; default: a generated surface.")
]
RanksOption = Annotated[int, typer.Option(help="Build on so many MPI ranks, started here; 0: without MPI.", min=0)]
JsonOption = Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write what was measured.")]


@app.callback()
def _options(
    debug: Annotated[bool, typer.Option("--debug", help="Show a traceback when something fails.")] = False,
) -> None:
    if debug:
        os.environ["SPLATPIPE_DEBUG"] = "1"


@app.command()
def run(
    config: Annotated[Path, typer.Argument(help="TOML file; configs/defaults.toml states every key.")],
    sets: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a key: output.frames=10.")
    ] = None,
    complete: Annotated[
        bool, typer.Option("--complete", help="Paged points: wait for all of a frame; sets memory.complete.")
    ] = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with a run that was cut short: draw only what is missing.")
    ] = False,
    json: JsonOption = None,
) -> None:
    """Draw a camera path: PNG frames, a film, and run.json with where the time went.

    Starts three MPI ranks by itself where the topology needs them; `mpirun -n 3 splatpipe run …` works as well.

    Example: `splatpipe run city.toml --set camera.width=1920 --set camera.height=1080`
    """
    from .run import run_command

    overridden = [*["memory.complete=true"] * complete, *["output.resume=true"] * resume]
    raise typer.Exit(run_command(config, [*(sets or []), *overridden], json))


@app.command()
def view(
    config: Annotated[Path, typer.Argument(help="TOML file, as of `splatpipe run`; [live] is its own table.")],
    sets: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a key: live.fps=20.")
    ] = None,
    bind: Annotated[str, typer.Option(help="Address to listen on; others than this machine's need the key, too.")] = (
        "127.0.0.1"
    ),
    port: Annotated[int, typer.Option(help="Of the page; 0: any that is free.", min=0, max=65535)] = 0,
    zmq_port: Annotated[int, typer.Option(help="For programs; 0: any that is free.", min=0, max=65535)] = 0,
    connection: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Where to write how programs connect; default: a private folder."),
    ] = None,
    record: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Keep what the monitor shows, to replay: `splatpipe monitor FILE`."),
    ] = None,
) -> None:
    """Show a scene in a web page, steered by whoever looks, drawn by as many ranks as the topology has.

    Prints the address of the page. `mpirun -n 3 splatpipe view …` works as well; Ctrl-C ends it.

    Example: `splatpipe view city.toml --set pipeline.topology=pipelined --port 8080`
    """
    from .live.view import Listening, view_command

    raise typer.Exit(view_command(config, sets or [], Listening(bind, port, zmq_port, connection, record)))


@app.command()
def monitor(
    target: Annotated[
        Path | None,
        typer.Argument(
            metavar="[CONNECTION|FILE]",
            help="Connection file, recording or run.json; default: this user's newest live run.",
        ),
    ] = None,
    show: Annotated[
        list[str] | None,
        typer.Option("--show", metavar="NAME", help="Also the course of a metric: cpu, 'render.*'; may be repeated."),
    ] = None,
    once: Annotated[bool, typer.Option("--once", help="Print what holds now, and end.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print the messages, a line each.")] = False,
    speed: Annotated[
        float | None,
        typer.Option(help="Of a replay; default: as recorded, at once where no terminal is.", min=0.01, max=1000),
    ] = None,
    at: Annotated[float, typer.Option(metavar="SECONDS", help="Of a replay: where to begin.", min=0)] = 0,
) -> None:
    """Show where a run's time goes, rank by rank, beside what the model expects: live, or of a recorded run.

    Example: `splatpipe monitor --show 'render.*'`
    """
    from .live.monitor import monitor_command

    raise typer.Exit(monitor_command(target, show or [], once=once, as_json=json, speed=speed, at=at))


@app.command()
def build(
    inputs: Annotated[list[str], typer.Argument(help="Files, folders or globs: LAS LAZ COPC PLY PCD XYZ CSV NPY E57.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Scene directory to make.")],
    order: Annotated[str, typer.Option(help="Point order: layered or depth-first.")] = "layered",
    points_per_cell: Annotated[int, typer.Option(help="A cell with more points is divided.")] = 4096,
    max_depth: Annotated[int, typer.Option(help="Deepest level of the octree, 0…21.")] = 21,
    flatness: Annotated[float, typer.Option(help="A cell flatter than this (λ₀ / Σλ) is not divided; 0: off.")] = 0.0,
    memory: Annotated[str, typer.Option(help="Memory to use, e.g. 4GB; default: half of what is free.")] = "",
    up: Annotated[str, typer.Option(help="Axis that points up: x, y, z, -x, -y, -z or auto.")] = "auto",
    attributes: Annotated[str, typer.Option(help="Keep only these, comma separated, e.g. rgb,normal.")] = "",
    normals: Annotated[str, typer.Option(help="keep those of the files, or estimate them from neighbours.")] = "keep",
    splats: Annotated[bool, typer.Option("--splats", help="Store what splats need: radii, and normals.")] = False,
    features: Annotated[
        bool, typer.Option("--features", help="Store which cells are flat, edges or corners; --splats with it.")
    ] = False,
    positions: Annotated[
        str, typer.Option(help="Store positions as float32, or coded: ci, eci, occupancy or groups (lossy).")
    ] = "float32",
    position_bits: Annotated[int, typer.Option(help="Coded: bits an axis of the grid in each cell; ci suits 6.")] = 12,
    group_epsilon: Annotated[
        float, typer.Option(help="groups: largest error, as a share of the scene's size.")
    ] = 0.001,
    group_detail: Annotated[
        float, typer.Option(help="groups: error at most this share of the extent of about 128 points; 0: off.")
    ] = 0.0,
    pools: Annotated[bool, typer.Option("--pools", help="Store dense cells as transformation streams, too.")] = False,
    pool_bits: Annotated[int, typer.Option(help="Pools: bits an axis, up to 8; 0: as suits --points-per-cell.")] = 0,
    n_pools: Annotated[int, typer.Option(help="Pools: most of a cell.")] = 2,
    strict: Annotated[bool, typer.Option(help="Refuse points that are not finite instead of dropping them.")] = False,
    overwrite: Annotated[bool, typer.Option(help="Replace an existing scene.")] = False,
    ranks: RanksOption = 0,
    json: JsonOption = None,
) -> None:
    """Build a scene from point files, larger than memory if need be.

    `mpirun -n N splatpipe build …` shares the work among ranks that see the same folders; so does `--ranks N`.

    Example: `splatpipe build 'survey/*.laz' -o survey.scene --memory 8GB`
    """
    from ..shared.build import BuildSettings
    from .scenes import build_command

    settings = BuildSettings(
        point_order=order,
        points_per_cell=points_per_cell,
        max_depth=max_depth,
        flatness=flatness,
        memory_bytes=parse_bytes(memory, "--memory") if memory else None,
        up=up,
        attributes=split_names(attributes),
        normals=normals,
        splats=splats,
        features=features,
        positions=positions,
        position_bits=position_bits,
        group_epsilon=group_epsilon,
        group_detail=group_detail,
        pools=pools,
        pool_bits=pool_bits,
        n_pools=n_pools,
        strict=strict,
        overwrite=overwrite,
    )
    raise typer.Exit(build_command(inputs, output, settings, json, ranks))


@app.command()
def synth(
    output: Annotated[Path, typer.Argument(help="Scene directory, or a file ending in .las or .laz.")],
    points: Annotated[int, typer.Option(help="Number of points.", min=1)] = 2_000_000,
    seed: Annotated[int, typer.Option(help="Another seed, another city.")] = 1,
    splats: Annotated[bool, typer.Option("--splats", help="As for `splatpipe build`.")] = False,
    features: Annotated[bool, typer.Option("--features", help="As for `splatpipe build`.")] = False,
    pools: Annotated[bool, typer.Option("--pools", help="As for `splatpipe build`.")] = False,
    extent: Annotated[float, typer.Option(help="Side of the city, metres, up to 873.")] = 225.0,
    memory: Annotated[str, typer.Option(help="As for `splatpipe build`.")] = "",
    attributes: Annotated[str, typer.Option(help="As for `splatpipe build`.")] = "",
    overwrite: Annotated[bool, typer.Option(help="Replace an existing scene.")] = False,
    ranks: RanksOption = 0,
    json: JsonOption = None,
) -> None:
    """Make a synthetic city scan: a scene directory, or a LAS/LAZ file.

    A scene larger than memory: `splatpipe synth large.scene --points 1000000000 --extent 873 --attributes rgb`

    Example: `splatpipe synth city.scene --points 2000000`
    """
    from ..shared.build import BuildSettings
    from .scenes import synth_command

    settings = BuildSettings(
        overwrite=overwrite,
        up="z",
        splats=splats,
        features=features,
        pools=pools,
        memory_bytes=parse_bytes(memory, "--memory") if memory else None,
        attributes=split_names(attributes),
    )
    raise typer.Exit(synth_command(output, points, seed, extent, settings, json, ranks))


@app.command()
def info(
    scene: Annotated[Path, typer.Argument(help="Scene or layer directory, or a point file.")],
    json: JsonOption = None,
) -> None:
    """Say what a scene, a layer or a point file holds.

    Example: `splatpipe info city.scene`
    """
    from .scenes import info_command

    info_command(scene, json)


@app.command()
def verify(scene: Annotated[Path, typer.Argument(help="Scene directory.")]) -> None:
    """Check every checksum, the octree's structure and that each point lies in its cell.

    Example: `splatpipe verify city.scene`
    """
    from .scenes import verify_command

    verify_command(scene)


@app.command()
def experiment(
    config: Annotated[Path, typer.Argument(help="Experiment file; configs/experiments has examples.")],
    fresh: Annotated[bool, typer.Option("--fresh", help="Start over instead of running what is missing.")] = False,
    json: JsonOption = None,
) -> None:
    """A grid of settings, each run several times in fresh processes: one table, its spread and where it came from.

    Killed and started again, it runs only what is missing.

    Example: `splatpipe experiment configs/experiments/threads.toml`
    """
    from .experiment.command import experiment_command

    experiment_command(config, fresh=fresh, json_path=json)


@app.command()
def plan(
    config: Annotated[Path, typer.Argument(help="Configuration of a run.")],
    sets: Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a key.")] = None,
    measure: Annotated[bool, typer.Option("--measure", help="Time each part against the run without it.")] = False,
    report: Annotated[Path | None, typer.Option(metavar="STEM", help="Write STEM.html and STEM.md.")] = None,
    json: JsonOption = None,
) -> None:
    """Say what a run needs, what it leaves out and why, and what that gains.

    Example: `splatpipe plan city.toml --measure --report plan`
    """
    from .plan.command import plan_command, print_plan, report_plan

    results = plan_command(config, sets or [], measure=measure)
    _report(results, print_plan, json)
    if report is not None:
        report_plan(results, report)


@app.command()
def model(
    config: Annotated[
        Path | None, typer.Argument(help="Configuration of a run; not needed if the file says it all.")
    ] = None,
    sets: Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a key.")] = None,
    system: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Read the cluster from a file: configs/systems has examples.")
    ] = None,
    save_system: Annotated[Path | None, typer.Option(metavar="FILE", help="Write what was measured.")] = None,
    fps: Annotated[float | None, typer.Option(help="Frames a second to hold; default: output.fps.")] = None,
    report: Annotated[Path | None, typer.Option(metavar="STEM", help="Write STEM.html and STEM.md.")] = None,
    json: JsonOption = None,
) -> None:
    """Measure the ranks, their links and a run, and say which bandwidth or rate each rank keeps up with.

    Example: `splatpipe model city.toml --fps 30 --report model`
    """
    from .model.command import make_model
    from .model.present import make_report, print_model, record

    found = make_model(config, sets or [], system, save_system, fps)
    _report(record(found), lambda _, console: print_model(found, console), json)
    if report is not None:
        make_report(found, " ".join(["splatpipe", *sys.argv[1:]])).write(report)


@app.command("model-rank", hidden=True)
def model_rank(
    config: Path,
    output: Path,
    rasterizer: str,
    render_rank: int,
    sets: Annotated[list[str] | None, typer.Option("--set")] = None,
) -> None:
    """One rank's part of `splatpipe model`, which starts it."""
    from .model.measure import rank_command

    rank_command(config, sets or [], output, rasterizer, render_rank)


@app.command("machine-rank", hidden=True)
def machine_rank(output: Path) -> None:
    """One rank's part of `splatpipe predict --links`, which starts it."""
    from .predict.machine import machine_rank

    machine_rank(output)


@app.command()
def error(
    config: Annotated[Path, typer.Argument(help="TOML file: base run, scenes, sweeps; configs/error has examples.")],
    json: JsonOption = None,
) -> None:
    """Error against run time: sweep settings, hold every picture against a float64 reference of all points.

    Writes errors.csv and a report (HTML and Markdown) with work–precision diagrams into run.output.directory.

    Example: `splatpipe error configs/error/demo.toml --json errors.json`
    """
    from .error.command import error_command

    error_command(config, json)


@app.command()
def stability(
    only: Annotated[str, typer.Option(metavar="NAME", help="Run the cases whose name contains this.")] = "",
    json: JsonOption = None,
    report: Annotated[
        Path | None, typer.Option("--report", metavar="STEM", help="Write STEM.html and STEM.md.")
    ] = None,
) -> None:
    """Run the stiff and extreme cases: value, bound and verdict of each. Exit status 1 if one fails.

    Example: `splatpipe stability --only projection --report stability`
    """
    from .stability.suite import stability_command

    raise typer.Exit(stability_command(only, json, report))


@app.command()
def predict(
    config: Annotated[Path, typer.Argument(help="Configuration of a run; with --validate an experiment file.")],
    sets: Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a key.")] = None,
    what_if: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KEY=VALUE", help="A key of the run, or cores, hosts, bandwidth, link, latency, speed, points."
        ),
    ] = None,
    ranks: Annotated[int, typer.Option(help="On paper, up to this many ranks.", min=3, max=1 << 16)] = 4096,
    repeats: Annotated[int, typer.Option(help="Runs of each calibration setting.", min=1)] = 3,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Runs and report; default: predicted, or where the experiment says."),
    ] = None,
    validate: Annotated[
        bool, typer.Option("--validate", help="Predicted beside measured, over an experiment.")
    ] = False,
    fresh: Annotated[bool, typer.Option("--fresh", help="Measure again instead of using what is there.")] = False,
    best: Annotated[
        bool, typer.Option("--best", help="Of each setting the fastest repeat: for a machine that others work on.")
    ] = False,
    links: Annotated[
        bool, typer.Option("--links", help="Measure the link between the hosts that mpiexec uses, and predict with it.")
    ] = False,
    json: JsonOption = None,
) -> None:
    """Frames/s, latency and bottleneck of other settings, cores and ranks, from costs fitted on a few measured runs.

    Example: `splatpipe predict configs/demo.toml --what-if cores=16 --what-if camera.width=3840`
    """
    from .predict.command import predict_command, validate_command

    settings = {"fresh": fresh, "best": best, "links": links, "json_path": json}
    if validate:
        validate_command(config, output, **settings)
    else:
        predict_command(config, sets or [], what_if or [], ranks, repeats, output or Path("predicted"), **settings)


@bench_app.command("raster")
def bench_raster(
    points: Annotated[int, typer.Option(help="Number of points.", min=1000)] = 4_000_000,
    size: Annotated[int, typer.Option(help="Width and height, pixels.", min=16, max=8192)] = 1024,
    repeats: Annotated[int, typer.Option(help="Timed frames of each.", min=3)] = 15,
    roofline: Annotated[
        bool, typer.Option("--roofline", help="Instead: what limits cpu, by part, from 512² to 3840×2160.")
    ] = False,
    json: JsonOption = None,
) -> None:
    """Every rasterizer present, VTK and NumPy on the same points in one run.

    Example: `splatpipe bench raster --json raster.json`
    """
    if roofline:
        from .bench.roofline import bench_roofline, print_roofline

        _report(bench_roofline(n_points=points, repeats=repeats), print_roofline, json)
        return
    from .bench.raster import bench_raster as measure
    from .bench.raster import print_raster

    _report(measure(n_points=points, size=size, repeats=repeats), print_raster, json)


@bench_app.command("avc")
def bench_avc(
    most: Annotated[int, typer.Option(help="Most blocks a side; the paper goes from 16 to 100.", min=16)] = 100,
    width: Annotated[int, typer.Option(help="Pixels.", min=16, max=8192)] = 1920,
    height: Annotated[int, typer.Option(help="Pixels.", min=16, max=8192)] = 1200,
    repeats: Annotated[int, typer.Option(help="Timed frames of each technique.", min=1)] = 5,
    plot: Annotated[Path | None, typer.Option(help="PNG file for both figures.")] = None,
    json: JsonOption = None,
) -> None:
    """Block worlds as attributed vertex clouds, by instancing, as strips and as triangles.

    Example: `splatpipe bench avc --most 64 --plot avc.png`
    """
    from .bench.avc import GRIDS, plot_avc, print_avc
    from .bench.avc import bench_avc as measure

    found = measure(grids=[n for n in GRIDS if n <= most], width=width, height=height, repeats=repeats)
    if plot is not None:
        plot_avc(found, plot)
    _report(found, print_avc, json)


@bench_app.command("splats")
def bench_splats(
    scenes: Annotated[list[Path], typer.Argument(help="Scenes built with --features.")],
    size: Annotated[int, typer.Option(help="Width and height, pixels.", min=16, max=8192)] = 1024,
    views: Annotated[int, typer.Option(help="Views from all around.", min=1)] = 4,
    repeats: Annotated[int, typer.Option(help="Timed frames of each view and way.", min=1)] = 7,
    pictures: Annotated[Path | None, typer.Option(help="Folder for pictures side by side.")] = None,
    json: JsonOption = None,
) -> None:
    """Thesis Table 4-4: feature-driven against normal visibility splatting, and holes of points and splats.

    Example: `splatpipe bench splats dragon.scene buddha.scene --pictures splats`
    """
    from .bench.splats import bench_splats as measure
    from .bench.splats import print_splats

    _report(measure(scenes, size=size, views=views, repeats=repeats, pictures=pictures), print_splats, json)


@bench_app.command("codecs")
def bench_codecs(
    inputs: CellInputs = None,
    bits: Annotated[int, typer.Option(help="Of the grid in a cell, an axis.", min=1, max=16)] = 7,
    cells: Annotated[int, typer.Option(help="At most so many cells of each scene, evenly spread.", min=1)] = 64,
    leaves: Annotated[bool, typer.Option("--leaves", help="Leaves only, not every cell that owns points.")] = False,
    points_per_cell: Annotated[int, typer.Option(help="Of scenes built from point files.", min=1)] = 4096,
    epsilon: Annotated[
        float, typer.Option(help="ε of linear groups, % of the scene's longest side.", min=0, max=100)
    ] = 0.5,
    size: Annotated[int, typer.Option(help="Width and height, pixels.", min=16, max=8192)] = 1024,
    repeats: Annotated[int, typer.Option(help="Times that each is measured.", min=1)] = 5,
    sizes: Annotated[
        str | None,
        typer.Option(metavar="M,M,…", help="Million points: frames only, of scenes so large, copied from a few cells."),
    ] = None,
    json: JsonOption = None,
) -> None:
    """Codecs of cells beside float32 and 10-bit fixed point: bytes, encode, decode, error, frame time.

    With `--sizes`: frames drawn from float32, fixed point, pools and groups, and from which size on each is faster than
    float32; ε is then a share of a cell's edge.

    Exit status 1 if what is decoded is not what was encoded.

    Example: `splatpipe bench codecs lion.scene dragon.ply --json codecs.json`
    """
    if sizes is not None:
        from .bench.codec_sizes import bench_sizes, print_sizes

        million = parse_numbers(sizes, "--sizes")
        found = bench_sizes(inputs or [], million, bits=bits, epsilon=epsilon / 100, size=size, repeats=repeats)
        _report(found, print_sizes, json)
        return
    from .bench.codecs import bench_codecs as measure
    from .bench.codecs import print_codecs

    results = measure(
        inputs or [],
        bits=bits,
        most_cells=cells,
        leaves=leaves,
        points_per_cell=points_per_cell,
        epsilon=epsilon / 100,
        size=size,
        repeats=repeats,
    )
    _report(results, print_codecs, json)
    raise typer.Exit(int(any(row["failed"] for row in results["rows"])))


@bench_app.command("budget")
def bench_budget(
    inputs: CellInputs = None,
    bits: Annotated[int, typer.Option(help="Of the grid in a cell, an axis.", min=1, max=8)] = 6,
    pools: Annotated[int, typer.Option(help="At most so many of a cell.", min=1, max=16)] = 2,
    cells: Annotated[int, typer.Option(help="At most so many leaves of each scene, evenly spread.", min=1)] = 1000,
    points_per_cell: Annotated[int, typer.Option(help="Of scenes built from point files.", min=1)] = 32768,
    size: Annotated[int, typer.Option(help="Width and height, pixels.", min=16, max=8192)] = 1024,
    repeats: Annotated[int, typer.Option(help="Timed frames of each way.", min=1)] = 9,
    json: JsonOption = None,
) -> None:
    """Frames drawn by OpenGL from pools and from points, with as much device memory: what does not fit is sent.

    Example: `splatpipe bench budget lion.ply --json budget.json`
    """
    from .bench.budget import bench_budget as measure
    from .bench.budget import print_budget

    results = measure(
        inputs or [],
        bits=bits,
        n_pools=pools,
        most_cells=cells,
        points_per_cell=points_per_cell,
        size=size,
        repeats=repeats,
    )
    _report(results, print_budget, json)


@bench_app.command("build")
def bench_build(
    points: Annotated[int, typer.Option(help="Number of points of the LAS file.", min=1000)] = 20_000_000,
    repeats: Annotated[int, typer.Option(help="Timed builds.", min=1)] = 3,
    ranks: Annotated[int, typer.Option(help="Also on so many MPI ranks of this host; 0: not.", min=0)] = 0,
    workdir: Annotated[Path | None, typer.Option(help="Where the file and the scenes go.")] = None,
    json: JsonOption = None,
) -> None:
    """LAS file → scene: points per second and peak memory, in memory, external and on MPI ranks.

    Example: `splatpipe bench build --points 20000000 --ranks 2 --json build.json`
    """
    from .bench.build import bench_build as measure
    from .bench.build import print_build

    _report(measure(n_points=points, repeats=repeats, ranks=ranks, workdir=workdir), print_build, json)


@bench_app.command("pipeline")
def bench_pipeline(
    config: Annotated[Path, typer.Argument(help="Configuration of a run.")],
    sets: Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a key.")] = None,
    repeats: Annotated[int, typer.Option(help="Runs of each topology.", min=1)] = 3,
    json: JsonOption = None,
) -> None:
    """Three ranks against the slowest of the three stages alone.

    Example: `splatpipe bench pipeline configs/demo.toml --set render.threads=1`
    """
    from .bench.pipeline import bench_pipeline as measure
    from .bench.pipeline import print_pipeline

    _report(measure(config, sets or [], repeats), print_pipeline, json)


@bench_app.command("paged")
def bench_paged(
    config: Annotated[Path, typer.Argument(help="Configuration of a run; its camera should move.")],
    sets: Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a key.")] = None,
    budgets: Annotated[str, typer.Option(metavar="SIZE,SIZE,…", help="Values of memory.budget.")] = "250MB,500MB,1GB",
    points: Annotated[str, typer.Option(metavar="M,M,…", help="Million points of sampling.point_budget.")] = "2,4,8",
    error_frames: Annotated[int, typer.Option(help="Frames compared with complete ones.", min=1)] = 5,
    json: JsonOption = None,
) -> None:
    """Points that stay on disk: error against run time for pools and budgets of points.

    Example: `splatpipe bench paged configs/out-of-core.toml --budgets 500MB,1GB --json paged.json`
    """
    from .bench.paged import bench_paged as measure
    from .bench.paged import print_paged

    sizes = split_names(budgets) or ()
    for size in sizes:
        parse_bytes(size, "--budgets")
    million = parse_numbers(points, "--points")
    found = measure(config, sets or [], budgets=sizes, million_points=million, error_frames=error_frames)
    _report(found, print_paged, json)


@bench_app.command("balance")
def bench_balance(
    topology: Annotated[str, typer.Option(help="One that has something to move.")] = "sort-first-only",
    ranks: Annotated[int, typer.Option(help="Number of ranks.", min=2)] = 2,
    sets: Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a key.")] = None,
    points: Annotated[int, typer.Option(help="Number of points.", min=1000)] = 4_000_000,
    share: Annotated[float, typer.Option(help="Share of them in one octant.", min=0, max=1)] = 0.9,
    per_cell: Annotated[int, typer.Option(help="Most points of a leaf of the octree.", min=1)] = 4096,
    size: Annotated[str, typer.Option(metavar="WIDTHxHEIGHT", help="Viewport, pixels.")] = "1280x720",
    frames: Annotated[int, typer.Option(help="Frames of the round that the camera makes.", min=1)] = 240,
    repeats: Annotated[int, typer.Option(help="Runs of each.", min=1)] = 3,
    workdir: Annotated[Path, typer.Option(help="Where the scene is built and kept.")] = Path("bench-balance"),
    json: JsonOption = None,
) -> None:
    """Load balance off against measured, on a scene with one hot octant and a moving camera.

    Example: `splatpipe bench balance --ranks 4 --points 1000000 --json balance.json`
    """
    from .bench.balance import bench_balance as measure
    from .bench.balance import print_balance

    width, height = map(int, parse_numbers(size.replace("x", ","), "--size", 2))
    results = measure(
        topology,
        ranks,
        sets or [],
        n_points=points,
        share=share,
        points_per_cell=per_cell,
        width=width,
        height=height,
        frames=frames,
        repeats=repeats,
        workdir=workdir,
    )
    _report(results, print_balance, json)


@bench_app.command("compositing")
def bench_compositing(
    ranks: Annotated[str, typer.Option(metavar="N,N,…", help="Numbers of ranks, each at least 2.")] = "2,4",
    sizes: Annotated[str, typer.Option(metavar="WIDTHxHEIGHT,…", help="Pictures, pixels.")] = "1280x720",
    coverages: Annotated[str, typer.Option(metavar="%,%,…", help="Pixels that a rank has drawn on.")] = "10,50",
    policies: Annotated[str, typer.Option(metavar="NAME,…", help="Of pipeline.compositing; all of them.")] = "",
    empty: Annotated[float, typer.Option(help="Ranks that have drawn nothing, %.", min=0, max=99)] = 0,
    radix: Annotated[int, typer.Option(help="Of radix-k.", min=2, max=1024)] = 8,
    frames: Annotated[int, typer.Option(help="Timed frames of each policy.", min=1)] = 15,
    plot: Annotated[Path | None, typer.Option(help="PNG file: measured and model, and the model by ranks.")] = None,
    json: JsonOption = None,
) -> None:
    """Policies of sort-last compositing on ranks started here, beside the model and radix-k's published figure.

    Exit status 1 if one policy's picture has other bits than another's.

    Example: `splatpipe bench compositing --ranks 2,3,4 --sizes 1280x720,1920x1080 --json compositing.json`
    """
    from .bench.compositing import bench_compositing as measure
    from .bench.compositing import parse_cases, plot_compositing, print_compositing

    cases = parse_cases(ranks, sizes, parse_numbers(coverages, "--coverages"), policies)
    found = measure(**cases, radix=radix, frames=frames, empty=empty / 100)
    if plot is not None:
        plot_compositing(found, plot)
    _report(found, print_compositing, json)
    raise typer.Exit(int(not all(row["same_bits"] for row in found["rows"])))


@bench_app.command("messages")
def bench_messages(
    inputs: Annotated[list[Path], typer.Argument(help="Configurations of runs, or scenes.")],
    sets: Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a key.")] = None,
    frames: Annotated[int, typer.Option(help="Frames of each, spread over the camera path.", min=1)] = 5,
    ranks: Annotated[int, typer.Option(help="Framebuffers also of one of so many shares.", min=1)] = 4,
    repeats: Annotated[int, typer.Option(help="Times that each is measured.", min=1)] = 5,
    json: JsonOption = None,
) -> None:
    """Coded messages: bytes, encode, decode, and the bandwidth below which coding pays.

    Exit status 1 if what is decoded is not what was coded.

    Example: `splatpipe bench messages configs/demo.toml survey.scene --json messages.json`
    """
    from .bench.messages import bench_messages as measure
    from .bench.messages import print_messages

    results = measure(inputs, sets or [], frames=frames, ranks=ranks, repeats=repeats)
    _report(results, print_messages, json)
    raise typer.Exit(int(any(row["failed"] for row in results["rows"])))


@bench_app.command("lod")
def bench_lod(
    points: Annotated[int, typer.Option(help="Number of points of each scene.", min=1000)] = 100_000_000,
    size: Annotated[str, typer.Option(metavar="WIDTHxHEIGHT", help="Viewport, pixels.")] = "1920x1080",
    thresholds: Annotated[str, typer.Option(help="Values of sampling.pixel_threshold.")] = "32",
    densities: Annotated[str, typer.Option(help="Values of sampling.points_per_pixel.")] = "1,1.25,1.5,2,3",
    frames: Annotated[int, typer.Option(help="Timed frames of each path.", min=1)] = 30,
    error_frames: Annotated[int, typer.Option(help="Frames of each path compared with all points.", min=1)] = 5,
    workdir: Annotated[Path, typer.Option(help="Where the scenes are built and kept.")] = Path("bench-lod"),
    json: JsonOption = None,
) -> None:
    """Level of detail over large generated scenes: time, and error against all points, of each setting.

    Example: `splatpipe bench lod --points 10000000 --densities 1,2,4 --json lod.json`
    """
    from .bench.lod import bench_lod as measure
    from .bench.lod import print_lod

    width, height = map(int, parse_numbers(size.replace("x", ","), "--size", 2))
    results = measure(
        points,
        width=width,
        height=height,
        thresholds=parse_numbers(thresholds, "--thresholds"),
        densities=parse_numbers(densities, "--densities"),
        frames=frames,
        error_frames=error_frames,
        workdir=workdir,
    )
    _report(results, print_lod, json)


def _report(results: dict[str, Any], show: Any, json: Path | None) -> None:
    from rich.console import Console

    from ..shared.files import write_json

    console = Console()
    show(results, console if console.is_terminal else Console(width=140))  # a piped table is not cut
    if json is not None:
        write_json(json, results)


def main() -> None:
    """Entry point of ``splatpipe``: one line and an exit status for whatever goes wrong."""
    ensure_compile_cache()
    try:
        app()
    except SplatpipeError as error:
        _fail(error, str(error), error.exit_status)
    except KeyboardInterrupt as error:
        _fail(error, "interrupted", 130)
    except MemoryError as error:
        _fail(error, f"out of memory: {error}", 1)
    except BrokenPipeError:
        os._exit(1)  # whoever read us has gone; nothing to say and nowhere to say it
    except OSError as error:
        full = error.errno in DISK_FULL  # also where numba keeps what it compiled
        where = error.filename or ("output or compile cache" if full else type(error).__name__)
        _fail(error, f"{where}: {'disk full' if full else error.strerror or error}", 2 if full else 1)
    except Exception as error:
        _fail(error, f"internal error: {type(error).__name__}: {error}; --debug shows where", 1)


def _fail(error: BaseException, message: str, status: int) -> None:
    if "SPLATPIPE_DEBUG" in os.environ:
        import traceback

        traceback.print_exception(error)
    print("splatpipe: " + " ".join(message.split("\n")), file=sys.stderr)
    sys.exit(status)


def split_names(text: str) -> tuple[str, ...] | None:
    """The comma-separated names of an option; None for none."""
    return tuple(name.strip() for name in text.split(",")) if text else None


def parse_numbers(text: str, option: str, count: int | None = None) -> list[float]:
    """The comma-separated positive numbers of an option. Raises InputError naming it."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if not values or not all(0 < value < 2**20 for value in values) or count not in (None, len(values)):
        raise InputError(f"{option} {text}: expected {count or 'some'} numbers above 0")
    return values
