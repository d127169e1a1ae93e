"""Render the same picture by gdtool, Cycles and Mitsuba, each in a process of its own, and measure its error."""
