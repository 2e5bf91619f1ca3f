"""What the panels of all modules share: their place in the interface, and texts of several lines."""

from __future__ import annotations

import textwrap

import bpy

#: The width of a letter, and of what surrounds a label: a margin, a box and an icon. In units of the interface.
LETTER_WIDTH, AROUND_WIDTH = 5.8, 80
#: The letters that fit into a sidebar of the default width.
LABEL_LETTERS = 34


class Panel:
    bl_category = "meniscus"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"


def draw_text(layout: bpy.types.UILayout, text: str, icon: str = "ERROR") -> None:
    # A label has one line, and Blender cuts it at the edge of the panel.
    for number, line in enumerate(textwrap.wrap(text, label_letters())):
        layout.label(text=line, icon="BLANK1" if number else icon)


def label_letters() -> int:
    """The letters that fit into a label of the panel that is drawn now."""
    region = bpy.context.region
    if region is None:
        return LABEL_LETTERS
    width = region.width / bpy.context.preferences.system.ui_scale
    return max(int((width - AROUND_WIDTH) / LETTER_WIDTH), LABEL_LETTERS // 2)


def reason_of(error: Exception) -> str:
    """The message of an error. Python's own would begin with a number, as in `[Errno 2] No such file`."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return str(error)
