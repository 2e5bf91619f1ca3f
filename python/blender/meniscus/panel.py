"""What the panels of all modules share: their place in the interface, and texts of several lines."""

from __future__ import annotations

import textwrap

import bpy

#: The letters that fit into a sidebar of the default width.
LABEL_LETTERS = 44


class Panel:
    bl_category = "meniscus"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"


def draw_text(layout: bpy.types.UILayout, text: str, icon: str = "ERROR") -> None:
    # A label has one line, and Blender cuts it at the edge of the panel.
    for number, line in enumerate(textwrap.wrap(text, LABEL_LETTERS)):
        layout.label(text=line, icon="BLANK1" if number else icon)
