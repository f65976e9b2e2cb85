"""What a person sees during a run: a bar on a terminal, one line per shape and group stage otherwise."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import Any

from rich.console import Console as RichConsole
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from ssmpipe.runner.batch import COHORT, Event


class _Pipe(RichConsole):
    """Leaves a closed pipe (``| head``) to the command line, which knows the exit code."""

    def on_broken_pipe(self) -> None:
        raise BrokenPipeError


class Console:
    """Lines and progress; ``verbosity`` is -1 (only errors), 0, 1 (every task) or 2 (with reasons)."""

    def __init__(self, verbosity: int = 0) -> None:
        self.verbosity = verbosity
        self.out = _Pipe(highlight=False, markup=False, soft_wrap=True, file=sys.stdout)
        self.err = _Pipe(highlight=False, markup=False, soft_wrap=True, file=sys.stderr)
        self._bar: Progress | None = None
        self._task: Any = None
        self._last = time.monotonic()

    def say(self, text: str, level: int = 0) -> None:
        """Print a line if ``level`` is asked for."""
        if self.verbosity >= level:
            (self._bar.console if self._bar else self.out).print(text, markup=False, highlight=False, soft_wrap=True)

    def warn(self, text: str) -> None:
        """Print a warning."""
        if self.verbosity >= 0:
            (self._bar.console if self._bar else self.err).print(f"warning: {text}", markup=False, soft_wrap=True)

    def error(self, text: str) -> None:
        """Print an error, whatever the verbosity."""
        (self._bar.console if self._bar else self.err).print(text, markup=False, highlight=False, soft_wrap=True)

    def table(self, table: Any) -> None:
        """Print a rich table; wide ones are not cut when the output is a file."""
        console = self.out if self.out.is_terminal else _Pipe(file=sys.stdout, width=200, highlight=False, markup=False)
        console.print(table)

    def __enter__(self) -> Console:
        if self.out.is_terminal and self.verbosity == 0:
            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TimeElapsedColumn(),
                console=self.out,
                transient=True,
            )
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def begin(self, text: str, total: int) -> None:
        """Start counting ``total`` tasks."""
        if self._bar is not None:
            if self._task is not None:
                self._bar.remove_task(self._task)
            self._task = self._bar.add_task(text, total=total)

    def event(self, event: Event) -> None:
        """Show what a child says."""
        if event.kind == "warning":
            self.warn(event.text)
            return
        who = "" if event.key == COHORT else f"{event.key} "
        if self._bar is not None and self._task is not None:
            if event.kind == "done" and event.key != COHORT:
                self._bar.advance(self._task)
            elif event.kind == "start":
                self._bar.update(self._task, description=f"{who}{event.step}")
            elif event.kind == "progress" and event.key == COHORT:
                self._bar.update(
                    self._task,
                    description=f"{event.step} {event.text}",
                    completed=event.done,
                    total=max(event.total, 1),
                )
        elif event.kind == "start":
            self.say(f"  {who}{event.step} ...", level=1)
        elif event.kind == "progress" and time.monotonic() - self._last > 60:
            self._last = time.monotonic()
            self.say(f"  {who}{event.step}: {event.done}/{event.total} {event.text}".rstrip())
