"""The error family: every error states a fact and, where there is one, a remedy."""

from __future__ import annotations


class SsmpipeError(Exception):
    """Base of all errors that are meant for the user.

    Parameters
    ----------
    fact : str
        What was found, in one line, with numbers.
    remedy : str, optional
        What the user can do about it. The runner adds patient, stage and file.

    Characters that a terminal could obey, or that cannot be written, become "?": facts quote what stands in files.

    Examples
    --------
    >>> str(SsmpipeError("the mesh has 2 components", "keep the largest with repair.components=largest"))
    'the mesh has 2 components; try: keep the largest with repair.components=largest'
    >>> str(SsmpipeError("the id is 'a\\x1b[2J'"))
    "the id is 'a?[2J'"
    """

    def __init__(self, fact: str, remedy: str | None = None) -> None:
        self.fact = _plain(fact)
        self.remedy = None if remedy is None else _plain(remedy)
        super().__init__(self.fact if self.remedy is None else f"{self.fact}; try: {self.remedy}")

    def __reduce__(self) -> tuple[type, tuple[str, str | None]]:
        return (type(self), (self.fact, self.remedy))


def _plain(text: str) -> str:
    return text if text.isprintable() else "".join(c if c.isprintable() or c in "\n\u00a0" else "?" for c in text)


class ConfigError(SsmpipeError):
    """The configuration cannot be run as written."""


class ArtifactError(SsmpipeError):
    """A file cannot be read as what it claims to be."""


class GeometryError(SsmpipeError):
    """Coordinates or parameters are unusable."""


class TopologyError(GeometryError):
    """The surface is not of the topological type that a stage needs."""


class FoldoverError(GeometryError):
    """A map that must be one-to-one folds over."""


class LandmarkError(SsmpipeError):
    """A named landmark is missing or does not lie on its surface."""


class ConvergenceError(SsmpipeError):
    """An iterative method ended without an acceptable result."""
