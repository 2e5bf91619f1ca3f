"""Surfaces of points and particle simulations in Blender.

Each module of `MODULES` registers its own classes, properties, handlers and timers, and removes all of them.
"""

from . import conversion, live, sequence

MODULES = (live, sequence, conversion)


def register() -> None:
    for module in MODULES:
        module.register()


def unregister() -> None:
    for module in reversed(MODULES):
        module.unregister()
