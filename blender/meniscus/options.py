"""The options of the method as Blender properties.

pymeniscus defines the options: their kinds, ranges, choices, defaults and help. A new option of the method
appears in the panel without code here.
"""

import re
from collections.abc import Callable
from typing import Any

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, StringProperty
from pymeniscus import OptionInfo, option_table

# Options with properties of their own in `live`, and options that have no effect on a mesh in Blender.
OTHERS = {"preset", "spacing", "columns", "radius_attribute", "quads", "temporal", "time_step"}
OTHER_GROUPS = {"Obstacles"}
# The options in the panel itself; the others are in subpanels by group.
MAIN = ("voxel_size", "position_smoothing", "laplacian_steps", "steps", "offset", "decimate")
UNITS = (
    ("d", "spacings", "Multiples of the particle spacing"),
    ("h", "voxels", "Multiples of the voxel size"),
    ("", "units", "The unit of the points"),
)
SHOWN = tuple(
    info for info in option_table() if info.name not in OTHERS and info.group not in OTHER_GROUPS
)
PRESETS = next(info for info in option_table() if info.name == "preset")

Update = Callable[[Any, bpy.types.Context], None]


def label_of(name: str) -> str:
    return name.replace("_", " ").capitalize()


def text_of(number: float) -> str:
    """A number as text. Blender stores 0.4 in 32 bits, as 0.4000000059: seven digits give 0.4 again."""
    return f"{number:.7g}"


def default_of(info: OptionInfo) -> tuple[str, str]:
    """The default that the help states, as text, and its unit; empty if it depends on other options."""
    found = re.search(r"\[default: (-?[0-9][0-9.]*)? ?(\w*)", info.help)
    number, word = found.groups(default="") if found else ("", "")
    return number or word, word if number else ""


def properties_of(info: OptionInfo, update: Update) -> dict[str, Any]:
    """The Blender properties of an option: whether it overrides the preset, its value, and for a length its
    unit."""
    default, unit = default_of(info)
    limits: dict[str, Any] = {}
    if found := re.fullmatch(r"(\S+) to (\S+)", info.range or ""):
        limits = {"min": float(found[1]), "max": float(found[2])}
    elif "positive" in info.help:
        limits = {"min": 0.0}
    try:
        number = float(default)
    except ValueError:
        number = limits.get("min") or (0.0 if info.name == "offset" else 1.0)
    about = {"name": label_of(info.name), "description": info.help, "update": update}
    made: dict[str, Any] = {}
    if info.choices:
        items = [(choice, label_of(choice), "") for choice in info.choices]
        made[info.name] = EnumProperty(
            items=items, default=default if default in info.choices else info.choices[0], **about
        )
    elif info.kind == "count":
        limits = {key: int(value) for key, value in limits.items()}
        made[info.name] = IntProperty(default=int(number), **limits, **about)
    elif info.kind == "switch":
        made[info.name] = BoolProperty(**about)
    elif info.kind == "text":
        made[info.name] = StringProperty(**about)
    else:
        made[info.name] = FloatProperty(default=number, precision=4, step=1, **limits, **about)
    if info.kind == "length":
        first = unit if unit in ("d", "h") else "d"
        # The voxel size cannot be in voxels.
        units = [item for item in UNITS if info.name != "voxel_size" or item[0] != "h"]
        made[f"{info.name}_unit"] = EnumProperty(name="Unit", items=units, default=first, update=update)
    made[f"use_{info.name}"] = BoolProperty(
        name=label_of(info.name), description=f"Override the preset. {info.help}", update=update
    )
    return made


def all_properties(update: Update) -> dict[str, Any]:
    """The annotations of a property group with all options."""
    made: dict[str, Any] = {}
    for info in SHOWN:
        made.update(properties_of(info, update))
    # Each frame is measured by itself: with auto, the preset could change from one frame to the next.
    items = [(name, label_of(name), "") for name in PRESETS.choices if name != "auto"]
    made["preset"] = EnumProperty(
        name="Preset", items=items, default=default_of(PRESETS)[0], description=PRESETS.help, update=update
    )
    return made


def values_of(group: bpy.types.PropertyGroup) -> dict[str, Any]:
    """The options of a property group, as keywords of pymeniscus."""
    values: dict[str, Any] = {"preset": group.preset}
    for info in SHOWN:
        if not getattr(group, f"use_{info.name}"):
            continue
        value = getattr(group, info.name)
        if info.kind == "length":
            value = text_of(value) + getattr(group, f"{info.name}_unit")
        elif info.kind == "number":
            value = text_of(value)
        values[info.name] = value
    return values


def coarse(values: dict[str, Any]) -> dict[str, Any]:
    """Options for a preview while a value is dragged: a coarse grid and few steps.

    Of the others, only those stay that fit this grid: a blend is at least three voxels.
    """
    kept = {"where", "radius_attribute", "radius_scale", "offset", "clip", "drop_islands", "spacing"}
    return {"preset": "preview", **{name: value for name, value in values.items() if name in kept}}


def draw(layout: bpy.types.UILayout, group: bpy.types.PropertyGroup, infos: list[OptionInfo]) -> None:
    """Draws a row for each option: a check box that overrides the preset, the value, and its unit."""
    layout.use_property_split = False
    for info in infos:
        row = layout.row(align=True)
        row.prop(group, f"use_{info.name}")
        value = row.row(align=True)
        value.enabled = getattr(group, f"use_{info.name}")
        value.prop(group, info.name, text="")
        if info.kind == "length":
            value.prop(group, f"{info.name}_unit", text="")
