"""The panel in the sidebar of the 3D view."""

from __future__ import annotations

from typing import Any

import bpy

from .session import current


class Panel(bpy.types.Panel):
    """Labels of parts, from a coseg daemon."""

    bl_idname = "VIEW3D_PT_coseg"
    bl_label = "coseg"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "coseg"

    def draw(self, context: Any) -> None:
        """Draws what can be done now, what goes on and what went wrong."""
        layout, settings = self.layout, context.scene.coseg
        width = columns(context)
        if current.error:
            box = layout.box()
            for i, line in enumerate(wrapped(current.error, width - 4)):
                box.label(text=line, icon="NONE" if i else "ERROR")
        if current.doing:
            layout.label(text=f"{current.doing} … {current.progress}", icon="SORTTIME")
        elif current.message:
            for line in wrapped(current.message, width):
                layout.label(text=line)
        if current.library is None:
            field(layout, settings, "endpoint")
            layout.operator("coseg.connect")
            return
        field(layout, settings, "collection")
        field(layout, settings, "parts")
        layout.operator("coseg.send")
        layout.operator("coseg.refresh")
        layout.separator()
        field(layout, settings, "label")
        field(layout, settings, "new_label")
        layout.operator("coseg.correct_selected")
        layout.operator("coseg.correct_by_materials")
        row = layout.row()
        row.operator("coseg.suggest")
        row.operator("coseg.undo", text="Undo")
        row = layout.row()
        row.operator("coseg.ask")
        row.operator("coseg.answer")
        row = layout.row()
        row.operator("coseg.skip")
        row.operator("coseg.cut_wrongly")
        layout.separator()
        layout.operator("coseg.separate")
        layout.operator("coseg.own_materials")
        # A daemon may have been stopped.
        layout.operator("coseg.connect", text="Connect Again")


def field(layout: Any, settings: Any, name: str) -> None:
    """A setting, with room for its name."""
    row = layout.split(factor=0.45)
    row.label(text=settings.bl_rna.properties[name].name)
    row.prop(settings, name, text="")


def columns(context: Any) -> int:
    """Characters that fit into a line of the sidebar."""
    if context.region is None:
        return 40
    return max(16, int(context.region.width / context.preferences.system.ui_scale - 40) // 6)


def wrapped(text: str, width: int) -> list[str]:
    """A text in lines of at most that many characters."""
    lines = [""]
    for word in text.split():
        if lines[-1] and len(lines[-1]) + len(word) >= width:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return lines


def register() -> None:
    """Adds the panel."""
    bpy.utils.register_class(Panel)


def unregister() -> None:
    """Takes it away."""
    bpy.utils.unregister_class(Panel)
