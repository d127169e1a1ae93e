"""Define a stage that needs core only: it copies its source, and can be slow or fail."""

import time
from typing import Annotated

import msgspec

from gdtool.core.errors import InputError
from gdtool.core.kinds import RendersContent
from gdtool.core.stage import FILE, Stage


class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    repeat: Annotated[int, msgspec.Meta(ge=1, le=10_000, description="copies")] = 1
    pause: float = 0.0
    extra: Annotated[str | None, msgspec.Meta(description="a file", extra=FILE)] = None


def run(inputs, options, out):
    content = inputs.main.read_bytes()
    if content == b"bad":
        raise InputError(inputs.main, "is bad", "give a good one")
    with out.step("copy"):
        for i in range(options.repeat):
            out.path(f"{i:03d}.png").write_bytes(content)
            if options.pause:
                time.sleep(options.pause)
    out.skip("polish", "nothing to polish", 0.5)
    out.content = RendersContent(frames=options.repeat, environment="none", light="none")


STAGE = Stage(name="toy", version=1, reads=("image-file",), writes="renders", Options=Options, run=run)

if __name__ == "__main__":
    from gdtool.commands import main

    def command():
        from gdtool.commands._stage_command import stage_command

        return stage_command(STAGE, "Toy.")

    main(command)
