"""`jeit study`: compute the scores of many electrode layouts, which a TOML file lists; the run can be stopped at any
moment and resumed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jeit.cli.options import QuietOption, StoppedError, naming_options_in_errors

if TYPE_CHECKING:
    from jeit.design.study import Progress, Study

study = typer.Typer(
    name="study",
    help="Sweep over layouts and what surrounds them, as a TOML file says: run, resume, status, report.",
)

StudyFileArgument = Annotated[Path, typer.Argument(metavar="STUDY.toml", help="What to sweep.", show_default=False)]
OutputOption = Annotated[
    Path | None, typer.Option("--output", "-o", help="Zarr store (default STUDY.zarr beside the file).")
]
PageOption = Annotated[Path | None, typer.Option("--page", help="HTML report (default STUDY.html beside the file).")]
SchedulerOption = Annotated[
    str | None, typer.Option(help="Address of a dask scheduler, such as tcp://host:8786; in this process unless given.")
]


@study.callback(invoke_without_command=True)
def _print_help(command_context: typer.Context) -> None:
    if command_context.invoked_subcommand is None:
        typer.echo(command_context.get_help())


@study.command()
def run(
    file: StudyFileArgument,
    output: OutputOption = None,
    page: PageOption = None,
    scheduler: SchedulerOption = None,
    quiet: QuietOption = False,
) -> None:
    """Run a study from its beginning, and write its report."""
    from jeit.design.study.lock import lock_store

    parameter_sweep, store_path = _read_study_and_path(file, output)
    if store_path.exists() and not (store_path / "zarr.json").is_file():
        raise ValueError(f"--output {store_path}: there is something else already; choose another name.")
    if store_path.exists():
        with lock_store(store_path, "study"):  # refuses while another process is writing, before the store is deleted
            pass
        raise ValueError(f"{store_path} is there already: 'jeit study resume {file}' goes on with it; or delete it.")
    _run_with_progress(parameter_sweep, file, store_path, page, scheduler, quiet)


@study.command()
def resume(
    file: StudyFileArgument,
    output: OutputOption = None,
    page: PageOption = None,
    scheduler: SchedulerOption = None,
    quiet: QuietOption = False,
) -> None:
    """Continue a study that was stopped; its finished chunks are not computed again."""
    from jeit.design.study.store import Store

    parameter_sweep, store_path = _read_study_and_path(file, output)
    if not store_path.exists():
        raise ValueError(f"there is no {store_path} to go on with: begin with 'jeit study run {file}'.")
    Store(parameter_sweep, store_path, create=False)  # checks that the path is the store of this study
    _run_with_progress(parameter_sweep, file, store_path, page, scheduler, quiet)


@study.command()
def status(file: StudyFileArgument, output: OutputOption = None) -> None:
    """Print how many points of a study are finished."""
    from jeit.arguments import counted
    from jeit.design.study import study_progress

    parameter_sweep, store_path = _read_study_and_path(file, output)
    if not store_path.exists():
        points_text, chunks_text = (
            counted(len(parameter_sweep.points), "point"),
            counted(len(parameter_sweep.chunks), "chunk"),
        )
        typer.echo(f"{parameter_sweep.name}: not begun; {points_text} in {chunks_text}.")
        return
    progress = study_progress(parameter_sweep, store_path)
    typer.echo(
        f"{parameter_sweep.name}: {progress.points} of {progress.all_points} points finished, in {progress.chunks} of "
        f"{progress.all_chunks} chunks."
    )


@study.command()
def report(file: StudyFileArgument, output: OutputOption = None, page: PageOption = None) -> None:
    """Write an HTML page with the finished results of a study."""
    from jeit.design.reports import write_study_report

    parameter_sweep, store_path = _read_study_and_path(file, output)
    report_path = _report_path(file, store_path, page)
    write_study_report(parameter_sweep, store_path, report_path)
    typer.echo(f"Written: {report_path}")


def _read_study_and_path(study_file: Path, requested_store_path: Path | None) -> "tuple[Study, Path]":
    """Read the study from its TOML file, and return it with the path of its store of results."""
    from jeit.design.study import read_study

    with naming_options_in_errors({"path": "study"}):
        return read_study(study_file), requested_store_path or study_file.with_suffix(".zarr")


def _report_path(study_file: Path, store_path: Path, requested_report_path: Path | None) -> Path:
    """Path of the HTML report. Raises `ValueError` if the folder of the report does not exist, and if the path is the
    path of the study file or of the store of results."""
    report_path = requested_report_path or study_file.with_suffix(".html")
    if not report_path.parent.is_dir():
        raise ValueError(f"--page {report_path}: there is no folder {report_path.parent}; make it first.")
    if report_path.resolve() in (study_file.resolve(), store_path.resolve()):
        raise ValueError(f"--page {report_path}: that is the study itself; choose another name.")
    return report_path


def _run_with_progress(
    parameter_sweep: "Study",
    study_file: Path,
    store_path: Path,
    requested_report_path: Path | None,
    scheduler_address: str | None,
    is_quiet: bool,
) -> None:
    from contextlib import ExitStack

    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    from jeit.arguments.extras import require_extra
    from jeit.cli.console import plain_console, print_written_files
    from jeit.design.reports import write_study_report
    from jeit.design.study import run_study

    report_path = _report_path(study_file, store_path, requested_report_path)
    require_extra("cluster", "a study")  # before the progress bar starts
    console = plain_console()
    task_column, time_column = (
        TextColumn(f"{{{column_field}}}", markup=False) for column_field in ("task.description", "task.fields[left]")
    )
    progress_columns = (task_column, BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), time_column)
    try:
        with ExitStack() as exit_stack:
            cluster_client = (
                None if scheduler_address is None else exit_stack.enter_context(connect_to_scheduler(scheduler_address))
            )
            progress_bar = exit_stack.enter_context(Bar(*progress_columns, console=console, disable=is_quiet))
            progress_task = progress_bar.add_task("points", total=len(parameter_sweep.points), left="")

            def show_progress(progress: "Progress") -> None:
                remaining_time_text = (
                    "" if progress.seconds_left is None else f"{_format_duration(progress.seconds_left)} left"
                )
                progress_bar.update(progress_task, completed=progress.points, left=remaining_time_text)

            run_study(parameter_sweep, store_path, client=cluster_client, progress=show_progress)
        write_study_report(parameter_sweep, store_path, report_path)
    except KeyboardInterrupt:
        if not store_path.exists():
            raise
        output_option = "" if store_path == study_file.with_suffix(".zarr") else f" --output {store_path}"
        raise StoppedError(f"stopped; 'jeit study resume {study_file}{output_option}' goes on with it.") from None
    if not is_quiet:
        print_written_files(console, store_path, str(report_path))


def connect_to_scheduler(scheduler: str):
    """Connect to the dask scheduler at the address `scheduler`. Raises `ValueError` if the scheduler does not
    answer."""
    from jeit.arguments.extras import import_optional

    try:
        return import_optional("distributed", "a cluster").Client(scheduler, timeout=10)
    except (OSError, ValueError) as error:
        raise ValueError(f"--scheduler {scheduler} does not answer: {error}") from None


def _format_duration(duration_seconds: float) -> str:
    """Format a duration as hours, minutes and seconds, such as "1:02:03"."""
    total_minutes, remaining_seconds = divmod(round(duration_seconds), 60)
    hours, remaining_minutes = divmod(total_minutes, 60)
    return (
        f"{hours}:{remaining_minutes:02}:{remaining_seconds:02}"
        if hours
        else f"{remaining_minutes}:{remaining_seconds:02}"
    )
