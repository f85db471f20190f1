"""Options as JSON, the form in which the compiled part takes everything that is not an array."""

from __future__ import annotations

import json
import math
from typing import Any

from ._errors import ArgumentError


def text(what: str, value: Any) -> str:
    """JSON of options. Numbers and arrays of NumPy are taken as Python's own.

    :param what: begins the message of an error, before the key of a value that is not a finite number
    """
    return json.dumps(_plain(what, value))


def _plain(where: str, value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(f"{where}: {key}", inner) for key, inner in value.items()}
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return [_plain(where, inner) for inner in value]
    if isinstance(value, float) and not math.isfinite(value):
        raise ArgumentError(f"{where} is {value}, expected a finite number")
    return value
