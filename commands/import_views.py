"""Define `gdtool import-views`; its options and help come from the stage."""

from gdtool.stages import import_views as stage

from ._stage_command import help_of, stage_command

command = stage_command(stage.STAGE, help=help_of(stage))
