# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The command ``pkm-twin``. Exit codes: 0 good, 1 rejected, 2 usage, 3 damaged, 4 no verdict."""

import gc
import sys
from collections.abc import Sequence
from typing import Final, NoReturn

import click

from pkm_twin.apps.groups import Tasks, commands
from pkm_twin.apps.options import REFUSED, SALVAGED
from pkm_twin.console import describe_system_error, discard_output, flush_output, print_message
from pkm_twin.errors import PkmTwinError, plain_warnings
from pkm_twin.files import open_standard_streams
from pkm_twin.ros.signals import INTERRUPTED, first_signal
from pkm_twin.threads import one_blas_thread

NAME: Final = "pkm-twin"


def _print_version(context: click.Context, _option: click.Parameter, asked: bool) -> None:
    if asked and not context.resilient_parsing:
        from importlib.metadata import PackageNotFoundError, version

        try:
            click.echo(f"{NAME} {version('pkm_twin')}")
        except PackageNotFoundError:
            click.echo(f"{NAME}, version unknown (not installed, runs from its sources)")
        context.exit()


app = Tasks(
    NAME,
    """Compute torques and stiffness of parallel robots, and compare recordings with the model.

    Start with `pkm-twin robots`, then `pkm-twin info delta_cu`; or check a recording with
    `pkm-twin check BAG`. SI units unless an option states others, world z up. Only play,
    monitor-torques and view --live need ROS.

    Exit codes: 0 good, 1 bad or invalid, 2 wrong usage, 3 damaged file (`recover` can save a
    part), 4 not judged (`check`). An error is one line on stderr. Results go to stdout, with --json
    as JSON only.

    \b
    For completion, a line of ~/.bashrc (in zsh with zsh_source, in fish with fish_source):
        eval "$(_PKM_TWIN_COMPLETE=bash_source pkm-twin)"
    """,
    commands(),
    metavar="COMMAND [ARGS]...",
    params=[
        click.Option(
            ["--version"],
            is_flag=True,
            is_eager=True,
            expose_value=False,
            callback=_print_version,
            help="Show the version and exit.",
        )
    ],
)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; report an error as one line with exit code 1, Ctrl-C with code 130."""
    # Disable garbage collection while modules load, which would take a tenth of a short command's time.
    gc.disable()
    open_standard_streams()
    one_blas_thread()
    try:
        with first_signal(lambda: SystemExit(INTERRUPTED)), plain_warnings():
            app(arguments, prog_name=NAME)
    except SystemExit:
        failed = flush_output()
        if failed and not isinstance(failed, BrokenPipeError):
            _exit_with_message(f"cannot write the output: {describe_system_error(failed)}")
        raise
    except BrokenPipeError:
        # The reader of the pipe has closed it, as `head` does.
        discard_output()
        sys.exit(REFUSED)
    except PkmTwinError as error:
        _exit_with_message(str(error), SALVAGED if error.salvageable else REFUSED)
    except OSError as error:
        flush_output()
        # An error without a file name comes from writing to stdout.
        _exit_with_message(f"{'' if error.filename else 'cannot write the output: '}{describe_system_error(error)}")


def _exit_with_message(text: str, code: int = REFUSED) -> NoReturn:
    print_message(text)
    sys.exit(code)


if __name__ == "__main__":
    main()
