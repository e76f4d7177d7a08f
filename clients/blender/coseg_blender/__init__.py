"""Labels of the parts of meshes, from a coseg daemon: a panel in the sidebar of the 3D view."""

from . import operators, panel, session


def register() -> None:
    """Adds the panel and its operators."""
    operators.register()
    panel.register()


def unregister() -> None:
    """Takes them away, and ends a daemon that was started here."""
    panel.unregister()
    operators.unregister()
    session.current.close()
