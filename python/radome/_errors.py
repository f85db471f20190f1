"""Exceptions of radome, and how the compiled part makes them."""

from __future__ import annotations

import errno
from typing import List, Optional


class RadomeError(Exception):
    """Error of radome.

    ``hint`` says what to do, or is ``None``. ``__cause__`` is the error that led to this one, if there was one.
    """

    hint: Optional[str]

    def __init__(self, message: str = "", hint: Optional[str] = None) -> None:
        super().__init__(message)
        self.message = message
        self.hint = hint

    def __str__(self) -> str:
        return self.message if self.hint is None else f"{self.message}\nhint: {self.hint}"


class ArgumentError(RadomeError, ValueError):
    """An argument has a value that it cannot have."""


class ArrayTypeError(RadomeError, TypeError):
    """An array has elements of a type that cannot be codes or angles."""


class ArrayValueError(RadomeError, ValueError):
    """An array has a shape or a value that does not fit."""


class FileError(RadomeError, OSError):
    """A file, folder or port cannot be used."""

    number: Optional[int] = None

    def __init__(self, message: str = "", hint: Optional[str] = None) -> None:
        super().__init__(message, hint)
        self.errno = self.number
        self.strerror = message


class MissingFileError(FileError, FileNotFoundError):
    """A file, folder or port does not exist."""

    number = errno.ENOENT


class ForbiddenFileError(FileError, PermissionError):
    """A file, folder or port may not be used."""

    number = errno.EACCES


class ExistingFileError(FileError, FileExistsError):
    """A file or folder exists and is not replaced."""

    number = errno.EEXIST


_BY_KIND = {
    "": RadomeError,
    "file": FileError,
    "not_found": MissingFileError,
    "permission": ForbiddenFileError,
    "exists": ExistingFileError,
}


def make(messages: List[str], kind: str) -> RadomeError:
    """Exception for a chain of messages, the outermost first. ``kind`` is a key of ``_BY_KIND``."""
    made: Optional[RadomeError] = None
    for depth in reversed(range(len(messages))):
        text, _, hint = messages[depth].partition("\n\nhint: ")
        error = (_BY_KIND[kind] if depth == 0 else RadomeError)(text, hint or None)
        error.__cause__ = made
        made = error
    return made if made is not None else RadomeError("unknown error")
