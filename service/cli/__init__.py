"""The command line ``smsr``: reconstruct here, serve, or talk to a server."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

import smsr
from service.cli import benchmark, demo, keys, local, remote, results, serve
from service.cli.exits import EXPECTED, HELP, console, leave

if TYPE_CHECKING:
    from collections.abc import Sequence

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog=HELP,
)

app.command()(local.reconstruct)
app.command()(local.evaluate)
app.command()(results.convert)
app.command()(results.plot)
app.command()(local.options)
app.command()(local.example)
app.command()(remote.submit)
app.command()(remote.batch)
app.add_typer(remote.jobs, name="jobs")
app.add_typer(keys.keys, name="keys")
app.command()(serve.serve)
app.command()(serve.worker)
app.command()(demo.demo)
app.command()(benchmark.benchmark)


def _print_version(wanted: bool) -> None:
    if wanted:
        console.print(f"smsr {smsr.__version__}")
        raise typer.Exit


@app.callback()
def top(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version and leave."
        ),
    ] = False,
) -> None:
    """Reconstruct moving 3D surfaces from 2D point tracks of one camera."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; expected errors end it with one line and an exit code.

    Parameters
    ----------
    arguments : sequence of str, optional
        Those of the process by default.
    """
    try:
        app(arguments, prog_name="smsr")
    except EXPECTED as error:
        leave(error)
