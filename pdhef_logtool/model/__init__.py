"""The model of one drive: how its log is read, its sensors and its car."""
