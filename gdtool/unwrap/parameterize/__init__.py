"""Flatten charts: `flatten` maps one chart to the plane, `schedule` flattens all and cuts those that do not fit."""
