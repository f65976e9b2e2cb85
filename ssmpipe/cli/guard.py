"""Whatever happens in a command becomes one line and an exit code."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import click


@contextmanager
def guarded(debug: bool, store: Path | None = None) -> Iterator[None]:
    """Turn whatever happens into one line and an exit code; see :mod:`ssmpipe.runner.exit_codes`.

    Parameters
    ----------
    debug : bool
        Whether errors are raised all the same.
    store : Path, optional
        Folder for the traceback of an internal error; that for temporary files where it does not exist.
    """
    from ssmpipe.core.errors import ConfigError, SsmpipeError
    from ssmpipe.runner.exit_codes import INTERNAL, INTERRUPTED, IO_ERROR, LOCKED, QUARANTINED, USAGE

    try:
        yield
    except (click.ClickException, click.exceptions.Exit, click.Abort):
        raise
    except KeyboardInterrupt:
        click.echo("interrupted; what is finished is kept, run the same command again to go on", err=True)
        sys.exit(INTERRUPTED)
    except BrokenPipeError:  # `ssmpipe ... | head`: whoever reads has seen enough
        with open(os.devnull, "w") as sink:
            for stream in (sys.stdout, sys.stderr):
                os.dup2(sink.fileno(), stream.fileno())
        sys.exit(141)
    except ConfigError as error:
        if debug:
            raise
        click.echo(f"{error}", err=True)
        sys.exit(USAGE)
    except SsmpipeError as error:
        if debug:
            raise
        from ssmpipe.runner.lock import LockHeldError
        from ssmpipe.runner.patience import ClusterLostError

        click.echo(f"{error}", err=True)
        lost = isinstance(error, ClusterLostError)
        sys.exit(LOCKED if isinstance(error, LockHeldError) else IO_ERROR if lost else QUARANTINED)
    except OSError as error:
        if debug:
            raise
        where = f": {error.filename}" if error.filename else ""
        click.echo(
            f"cannot read or write{where}: {error.strerror or error}; try: free space, or check permissions", err=True
        )
        sys.exit(IO_ERROR)
    except Exception as error:
        if debug:
            raise
        click.echo(f"internal error: {type(error).__name__}: {error}; {_store_traceback(store)}", err=True)
        sys.exit(INTERNAL)


def _store_traceback(folder: Path | None) -> str:
    import tempfile
    import traceback

    text = traceback.format_exc()
    for place in (folder, Path(tempfile.gettempdir())):
        if place is None or not place.is_dir():
            continue
        try:
            path = place / "ssmpipe-traceback.txt"
            path.write_text(text, encoding="utf-8")
            return f"the traceback is in {path}"
        except OSError:
            continue
    return "run again with --debug to see the traceback"


def debugging() -> bool:
    """Say whether the command at work was called with ``--debug``."""
    return bool(click.get_current_context().find_root().params.get("debug", False))
