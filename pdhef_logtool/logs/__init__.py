"""Reading and writing of drive logs as columns of topics on their own clocks.

Every format implements :class:`~.drive_log.DriveLog`; damage is a loss at its place, and all input has resource limits.
It must not import anything that assigns meaning to a column.
"""
