"""Published sideslip estimators, re-implemented, on the recorded drives beside the presets of this tool."""
