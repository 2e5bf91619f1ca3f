"""Particles that several tests use, and a setting of their processes."""

from __future__ import annotations

import signal
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[2]
FRAMES = ROOT / "examples" / "frames"


def lattice(edge: int, spacing: float = 0.1, dtype: type = np.float32) -> NDArray:
    """A cube of particles on a lattice."""
    axis = np.arange(edge) * spacing
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3).astype(dtype)


def heed_interrupts() -> None:
    """In a new process: lets Ctrl-C interrupt it. Processes that a shell starts in the background ignore it, and
    their children inherit that."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.fixture(scope="session")
def block() -> NDArray:
    return lattice(10)


@pytest.fixture(scope="session")
def surface(block: NDArray):
    import pymeniscus

    return pymeniscus.reconstruct(block, spacing=0.1)


@pytest.fixture(scope="session")
def frame() -> Path:
    return sorted(path for path in FRAMES.iterdir() if path.is_file())[0]
