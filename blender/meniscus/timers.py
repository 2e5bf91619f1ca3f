"""Timers that survive an error: Blender removes a timer that raises one."""

from __future__ import annotations

import functools
import traceback
from collections.abc import Callable

ERROR_SECONDS = 1.0


def lasting(tick: Callable[[], float]) -> Callable[[], float]:
    """A timer that prints its errors, and continues."""

    @functools.wraps(tick)
    def wrapper() -> float:
        try:
            return tick()
        except Exception:
            traceback.print_exc()
            return ERROR_SECONDS

    return wrapper
