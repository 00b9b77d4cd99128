"""`jeit live`: image a device's frames as they arrive, on a page in the browser."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from jeit.cli.options import (
    AsIsOption,
    ContactOption,
    DescriptionOption,
    FormatOption,
    QuietOption,
    ReferenceKeyOption,
    check_positive,
    convert_to_number_if_possible,
    naming_options_in_errors,
    read_file,
)


def live(
    source: Annotated[
        str,
        typer.Argument(
            help="demo, a simulated tank in which a rod goes round, or demo:skin, a skin that is stroked; - for lines "
            "on standard input; a recording; serial:PORT@BAUD; tcp:HOST:PORT; or a folder into which an instrument "
            "writes a file for each frame.",
            show_default=False,
        ),
    ],
    reference: Annotated[
        Path | None,
        typer.Option(
            help="Measured file of the undisturbed body; says protocol and electrodes. Without it, a description says "
            "them, and the first frames are the reference.",
            show_default=False,
        ),
    ] = None,
    reference_key: ReferenceKeyOption = None,
    format: FormatOption = None,
    description: DescriptionOption = None,
    model: Annotated[
        Path | None,
        typer.Option(
            help="Folder of 'jeit touch fit', 'jeit touch gestures' or 'jeit learn image': places and forces, gestures "
            "as they are named, or depth.",
            show_default=False,
        ),
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(
            help="File of 'jeit calibrate-microphones': a frame is an intensity for each microphone.",
            show_default=False,
        ),
    ] = None,
    contacts: Annotated[bool, typer.Option("--contacts", help="Find contacts, and show their paths.")] = False,
    method: Annotated[
        str | None,
        typer.Option(
            help="gauss-newton (default), levenberg-marquardt, or one-step for linear images (default of demo)."
        ),
    ] = None,
    hyperparameter: Annotated[
        str | None,
        typer.Option(help="A number, or the rule that chooses it (default noise-figure).", metavar="VALUE|RULE"),
    ] = None,
    steps: Annotated[int | None, typer.Option(help="Most iterations for a frame (default 4).")] = None,
    memory: Annotated[
        float | None,
        typer.Option(help="Frames over which an image changes: smooths in time (Kalman). 0 (default): none."),
    ] = None,
    contact: ContactOption = None,
    num_points: Annotated[int | None, typer.Option(help="Nodes of the mesh, about (default 1200).")] = None,
    as_is: AsIsOption = False,
    rate: Annotated[
        float | None,
        typer.Option(help="Frames in a second of a recording or of the demonstration, unless as recorded."),
    ] = None,
    untouched: Annotated[
        float, typer.Option(help="Seconds at the beginning in which the sensor is undisturbed, without a --reference.")
    ] = 1.0,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for recordings; made when one begins.")] = Path(
        "jeit-live"
    ),
    record: Annotated[bool, typer.Option("--record", help="Record from the first frame on.")] = False,
    host: Annotated[
        str, typer.Option(help="Address to listen at; 0.0.0.0 lets other machines in that have the token.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port to listen at; 0 takes a free one.", min=0, max=65535)] = 0,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Print the address, and open nothing.")] = False,
    until_end: Annotated[
        bool, typer.Option("--until-end", help="Stop when the source ends, not on Ctrl-C alone.")
    ] = False,
    quiet: QuietOption = False,
) -> None:
    """Image frames as they arrive, on a page in the browser; 'jeit live demo' needs no device.

    The options select what is shown: the change of conductivity (default), contacts (--contacts), a learnt skin,
    gestures or depth (--model), or the loss map of microphones (--calibration). The page can take a new reference,
    record frames, mark events, pause, and step back. Ctrl-C ends the session.
    """
    from jeit.arguments import counted
    from jeit.arguments.extras import require_extra
    from jeit.cli.console import Steps, plain_console
    from jeit.imaging.stream_preparation import StreamSettings
    from jeit.live.preparation import prepare
    from jeit.live.recording import Recorder
    from jeit.live.server import check_port, serve
    from jeit.live.session import Session

    require_extra("live", "a page in the browser")
    check_positive({"--untouched": untouched} | ({} if rate is None else {"--rate": rate}))
    setting_options = {
        "solver": method,
        "max_steps": steps,
        "hyperparameter": None if hyperparameter is None else convert_to_number_if_possible(hyperparameter),
        "memory": memory,
        "contact": contact,
        "num_points": num_points,
        "as_is": as_is or None,
    }
    setting_options = {name: option_value for name, option_value in setting_options.items() if option_value is not None}
    _check_unused_options(setting_options, model, calibration, contacts)
    if source.partition(":")[0] == "demo" and steps is None:
        setting_options.setdefault("solver", "one-step")  # compiles in half the time
    with naming_options_in_errors(_OPTION_NAMES):
        stream_settings = StreamSettings(**setting_options)
    console = plain_console()
    check_port(host, port)
    _check_folder(output)
    with Steps(console, quiet=quiet) as report_step, naming_options_in_errors(_ARGUMENT_OPTIONS):
        report_step("read")
        # With a model, the reference is a file of frames without a protocol, as `jeit touch predict` reads it.
        reference_input = reference
        if reference is not None and model is None:
            reference_input = read_file("--reference", reference, format, description, key=reference_key)
        prepared_stream = prepare(
            source,
            reference_input,
            description=description,
            model=model,
            calibration=calibration,
            contacts=contacts,
            settings=stream_settings,
            rate=rate,
            untouched=untouched,
            progress=report_step,
        )
    if not quiet:
        for _, message_text in prepared_stream.source.messages.copy():
            console.print(f"  note: {message_text}", soft_wrap=True)
    if until_end:
        prepared_stream.source.end_when_lost()
    frame_recorder = Recorder(output, reference=prepared_stream.reference)
    if record:
        frame_recorder.start()
    with _handle_sigterm() as received_signals:
        with Session(prepared_stream.source, prepared_stream.view, recorder=frame_recorder) as session:
            serve(
                session,
                host=host,
                port=port,
                stay=not until_end,
                opened=lambda page_address: _open_page(
                    page_address, console, is_browser_wanted=not no_browser, is_quiet=quiet
                ),
            )
        session_state = session.state()
    if not quiet:
        _print_counters(console, session_state)
    if until_end and not session_state["imaged"]:
        first_reason = next(iter(session_state["reasons"]), "the source ended before the first")
        raise ValueError(f"{counted(session_state['read'], 'frame')}, and none could be imaged: {first_reason}")
    if received_signals:
        raise typer.Exit(128 + signal.SIGTERM)


@contextmanager
def _handle_sigterm() -> Iterator[list[int]]:
    """Context in which the signal SIGTERM is treated like Ctrl-C; yields the list of received signals."""
    received_signals: list[int] = []

    def raise_stop(signal_number: int, _) -> None:
        received_signals.append(signal_number)
        raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield received_signals
        return
    previous_handler = signal.signal(signal.SIGTERM, raise_stop)
    try:
        yield received_signals
    finally:
        signal.signal(signal.SIGTERM, previous_handler)


# Maximum number of printed reasons why frames were refused.
_MAX_REASONS = 8
_OPTION_NAMES = {"solver": "--method", "max_steps": "--steps"}
_ARGUMENT_OPTIONS = {
    "source": "SOURCE",
    "rate": "--rate",
    "description": "--description",
    "reference": "--reference",
    "model": "--model",
    "calibration": "--calibration",
    "untouched": "--untouched",
}


def _check_folder(output_folder: Path) -> None:
    """Raise `ValueError` if no folder can be created at `output_folder`; the folder is created only when a recording
    begins."""
    existing_path = next(
        path for path in (output_folder.absolute(), *output_folder.absolute().parents) if path.exists()
    )
    if not (existing_path.is_dir() and os.access(existing_path, os.W_OK)):
        raise ValueError(
            f"--output: no folder '{output_folder}' can be made or written to; '{existing_path}' is in the way."
        )


def _check_unused_options(
    setting_options: dict, model: Path | None, calibration_path: Path | None, has_contacts: bool
) -> None:
    """Raise `ValueError` if options of conductivity images are given together with a model or microphones, which do not
    use these options."""
    used_options = [_OPTION_NAMES.get(name, f"--{name.replace('_', '-')}") for name in setting_options] + [
        "--contacts"
    ] * has_contacts
    for option_name, option_value in (("--model", model), ("--calibration", calibration_path)):
        if option_value is not None and used_options:
            raise ValueError(f"{used_options[0]} has no use with {option_name}; leave it out.")


def _open_page(page_address: str, console, *, is_browser_wanted: bool, is_quiet: bool) -> None:
    """Print the address of the page, and open it in a browser if there is a display."""
    is_browser_opened = is_browser_wanted and _has_display()
    if not (is_quiet and is_browser_opened):
        console.print(f"  {page_address}" + ("" if is_browser_opened else "  (open it in a browser)"), soft_wrap=True)
    if is_browser_opened:
        import webbrowser

        # Some browsers return only when their window is closed.
        threading.Thread(target=webbrowser.open, args=(page_address,), daemon=True).start()


def _has_display() -> bool:
    """Whether a window can be opened. A text browser is not opened, since it would occupy the terminal."""
    if sys.platform in ("win32", "darwin"):
        return True
    return any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"))


def _print_counters(console, session_state: dict) -> None:
    """Print the numbers of frames that a session received, imaged, refused and skipped."""
    from jeit.arguments import counted

    count_texts = [f"{session_state[name]} {name}" for name in ("imaged", "dropped", "refused") if session_state[name]]
    console.print(f"\n{counted(session_state['read'], 'frame')}: {', '.join(count_texts) or 'none imaged'}")
    if session_state["latency_median"] is not None:
        median_latency, latency_99 = 1e3 * session_state["latency_median"], 1e3 * session_state["latency_99"]
        console.print(f"latency to the picture: median {median_latency:.1f} ms, 99 % within {latency_99:.1f} ms")
    for image_status in ("partial", "unchanged", "step limit"):
        if session_state["statuses"].get(image_status):
            console.print(f"  {session_state['statuses'][image_status]} {image_status}")
    counted_reasons = sorted(session_state["reasons"].items(), key=lambda reason_and_count: -reason_and_count[1])
    for refusal_reason, reason_count in counted_reasons[:_MAX_REASONS]:
        console.print(f"  {reason_count} × {refusal_reason}", soft_wrap=True)
    if len(counted_reasons) > _MAX_REASONS:
        console.print(f"  {len(counted_reasons) - _MAX_REASONS} more reasons")
