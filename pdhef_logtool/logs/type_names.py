"""ROS type names in their two spellings."""

from __future__ import annotations


def ros2_type_name(name: str) -> str:
    """Return ``pkg/msg/Type`` for ``pkg/Type``, ``pkg/msg/Type`` and ``pkg::msg::Type``; anything else unchanged."""
    parts = name.replace("::", "/").split("/")
    if len(parts) == 2 and all(parts):
        return f"{parts[0]}/msg/{parts[1]}"
    return "/".join(parts)
