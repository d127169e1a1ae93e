"""Check that every error names a cure, and only options that its command has.

All messages are read from the source. Checked are the calls that construct an error of core/errors.py, and the calls of
functions that take a `cure` and build one.
"""

import ast
import importlib
import re
from functools import cache
from pathlib import Path

import click
import pytest

from gdtool.commands import COMMANDS
from tests.conftest import ROOT

# The place of the cure among the arguments.
ERRORS = {"GdtoolError": 2, "InputError": 2, "UsageError": 2, "OutputError": 2, "ResourceError": 2}
# A cure that says no more than this names no option, command or value.
GENERIC = re.compile(
    r"(please )?((check|fix|correct|repair|change|see|look at|verify|use|give|provide|choose|try) "
    r"(it|that|the|your|a|an|another|other|valid|right|correct"
    r"|the right|the correct|a valid|a correct|a different|another valid)?( "
    r")?(input|file|files|folder|data|value|values|arguments?|options?|configuration"
    r"|documentation|docs|manual|message|format|name|setting|settings|again|once more)?|try again|retry|run it "
    r"again|contact .*|report it|unknown|none|n/?a)\W*",
    re.IGNORECASE,
)
# Another program's command, with its own options.
FOREIGN = re.compile(r"\b(?:apt|conda|hf|pip|python|ray|torchrun) [^;,]*")
OTHER = re.compile(r"\bgdtool ([a-z][a-z-]*)([^;,]*)")  # another command of gdtool, with that one's options
OPTION = re.compile(r"(?<![\w-])--[a-z][a-z0-9]*(?:-[a-z0-9]+)*")
# Options that a message may name though not every command that reaches its module has them: by file and function.
EXCEPTIONS: dict[tuple[str, str], tuple[set[str], str]] = {
    ("gdtool/core/cluster.py", "_connected"): ({"--ray"}, "called where --ray was given, by the commands that have it"),
    ("gdtool/stages/early.py", "require_device"): ({"--device"}, "called by the commands whose stage runs networks"),
    ("gdtool/stages/early.py", "require_fov"): ({"--fov"}, "called by the stages that have --fov"),
    ("gdtool/diffusion/inference/sampling.py", "used_with"): (
        {"--eta", "--scheduler"},
        "train samples with the model's own settings; only sample-views has options for them",
    ),
    ("commands/_options.py", "shard_of"): ({"--shard"}, "called where --shard was given, by the commands that have it"),
}

FILES = {
    str(path.relative_to(ROOT)): ast.parse(path.read_text())
    for folder in ("gdtool", "commands")
    for path in sorted((ROOT / folder).rglob("*.py"))
}


def module_of(file):
    parts = list(Path(file).with_suffix("").parts)
    return ".".join((["gdtool"] if parts[0] == "commands" else []) + (parts[:-1] if parts[-1] == "__init__" else parts))


MODULES = {module_of(file): file for file in FILES}


@cache
def options_of(command):
    """Return all spellings of a command's options, and of gdtool's own."""
    from gdtool.commands._group import cli

    click_command = importlib.import_module("gdtool.commands." + command.replace("-", "_")).command
    with click.Context(click_command) as context:
        params = [*click_command.get_params(context), *cli.params]
    return {"--help", "--version"} | {
        name for param in params if isinstance(param, click.Option) for name in (*param.opts, *param.secondary_opts)
    }


@cache
def mentioned(module):
    """Return the modules of gdtool that a module imports anywhere, or names as "module:function" in a string."""
    modules = set()
    for node in ast.walk(FILES[MODULES[module]]):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            modules |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif (
            isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and re.fullmatch(r"gdtool(\.\w+)+(:\w+)?", node.value)
        ):
            modules.add(node.value.partition(":")[0])
    return modules & MODULES.keys()


@cache
def reached(module):
    """Return a module and all modules that its imports lead to."""
    seen, waiting = {module}, [module]
    while waiting:
        new = mentioned(waiting.pop()) - seen
        seen |= new
        waiting += new
    return seen


def commands_of(file):
    """Return the commands that can raise the errors of a file."""
    module, folder, stem = module_of(file), file.split("/")[-2], Path(file).stem
    if stem.replace("_", "-") in COMMANDS and folder in ("stages", "commands"):
        return {stem.replace("_", "-")}
    if file.startswith(("commands/", "gdtool/core/")):
        return set(COMMANDS)
    return {name for name in COMMANDS if module in reached("gdtool.stages." + name.replace("-", "_"))}


def functions(tree):
    return [node for node in ast.walk(tree) if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))]


def place_of_cure(function):
    """Return the position of `cure` among the arguments of a call; None where it is given by name only."""
    names = [argument.arg for argument in (*function.args.posonlyargs, *function.args.args)]
    return names.index("cure") - (names[:1] in (["self"], ["cls"])) if "cure" in names else None


def default_cure(function):
    """Return the default of a function's `cure`; None where it has none."""
    arguments = [*function.args.posonlyargs, *function.args.args]
    defaults = zip(arguments[len(arguments) - len(function.args.defaults) :], function.args.defaults, strict=True)
    return next(
        (
            value
            for argument, value in (*defaults, *zip(function.args.kwonlyargs, function.args.kw_defaults, strict=True))
            if argument.arg == "cure"
        ),
        None,
    )


# Functions that build errors of a `cure` that they are given, and those that can do without.
TAKING = [
    (file, function)
    for file, tree in FILES.items()
    for function in functions(tree)
    if function.name != "__init__"
    and any(argument.arg == "cure" for argument in (*function.args.args, *function.args.kwonlyargs))
]
HELPERS = {function.name: place_of_cure(function) for _, function in TAKING}
OPTIONAL = {function.name for _, function in TAKING if default_cure(function) is not None}


def name_called(call):
    return (
        call.func.id
        if isinstance(call.func, ast.Name)
        else call.func.attr
        if isinstance(call.func, ast.Attribute)
        else ""
    )


def constants_of(tree):
    """Return the strings that have a name at the top of a module."""
    return {
        node.targets[0].id: node.value
        for node in tree.body
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name)
    }


def constants(file):
    own = constants_of(FILES[file])
    for node in ast.walk(FILES[file]):
        if isinstance(node, ast.ImportFrom) and node.module in MODULES:
            theirs = constants_of(FILES[MODULES[node.module]])
            own |= {alias.asname or alias.name: theirs[alias.name] for alias in node.names if alias.name in theirs}
    return own


def texts(node, named_strings):
    """Return the texts that an expression can be, with "…" for unknown parts; none where nothing is known."""
    if isinstance(node, ast.Constant):
        return [node.value] if isinstance(node.value, str) else []
    if isinstance(node, ast.JoinedStr):
        out = [""]
        for part in node.values:
            inner = texts(part.value if isinstance(part, ast.FormattedValue) else part, named_strings) or ["…"]
            out = [text + one for text in out for one in inner]
        return out
    if isinstance(node, ast.IfExp):
        return texts(node.body, named_strings) + texts(node.orelse, named_strings)
    if isinstance(node, ast.BoolOp):
        return [text for value in node.values for text in texts(value, named_strings)]
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return [
            one + two
            for one in texts(node.left, named_strings) or ["…"]
            for two in texts(node.right, named_strings) or ["…"]
        ]
    if isinstance(node, ast.Name) and node.id in named_strings:
        return texts(named_strings[node.id], {})
    if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):  # repair.NO_AREA
        found = [file for module, file in MODULES.items() if module.endswith("." + node.value.id)]
        return [text for file in found for text in texts(constants_of(FILES[file]).get(node.attr), {})]
    return []


class Message:
    """Hold a call that constructs an error: its place, and the expressions of its arguments."""

    def __init__(self, file, function, call):
        self.file, self.function, self.call, self.name = file, function, call, name_called(call)
        place = ERRORS.get(self.name, HELPERS.get(self.name))
        named = next((keyword.value for keyword in call.keywords if keyword.arg == "cure"), None)
        self.cure = (
            named if named is not None else call.args[place] if place is not None and len(call.args) > place else None
        )
        self.where = f"{file}:{call.lineno}"

    def cures(self):
        return texts(self.cure, constants(self.file)) if self.cure is not None else []

    def words(self):
        known = constants(self.file)
        return [
            text
            for node in (*self.call.args, *(keyword.value for keyword in self.call.keywords))
            for text in texts(node, known)
        ]


def messages_of(file):
    out = []

    def look(node, function):
        for child in ast.iter_child_nodes(node):
            inside = child.name if isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef)) else function
            if isinstance(child, ast.Call) and (name_called(child) in ERRORS or name_called(child) in HELPERS):
                out.append(Message(file, inside, child))
            look(child, inside)

    look(FILES[file], "")
    return out


MESSAGES = [message for file in FILES for message in messages_of(file)]


def test_the_messages_are_found():
    assert len(MESSAGES) > 150
    assert {"geometry", "bake", "diffusion", "images", "stages", "core"} <= {m.file.split("/")[1] for m in MESSAGES}


def test_every_error_has_a_cure():
    lacking = [
        m.where
        for m in MESSAGES
        if m.cure is None
        and m.name not in OPTIONAL
        or "" in m.cures()
        or isinstance(m.cure, ast.Constant)
        and not m.cure.value
    ]
    assert not lacking, f"say what removes the fault: {lacking}"


def test_no_function_has_an_empty_default_cure():
    """A parameter `cure` has no default, or one that is not empty; with None the function supplies the text."""
    lacking = [
        f"{file}:{function.lineno} {function.name}"
        for file, function in TAKING
        if "" in texts(default_cure(function), constants(file))
    ]
    assert not lacking, f"let those who call say what removes the fault: {lacking}"


def test_no_cure_is_generic():
    generic = [(m.where, cure) for m in MESSAGES for cure in m.cures() if GENERIC.fullmatch(cure.strip())]
    assert not generic, f"name an option, a command or a value: {generic}"


@pytest.mark.parametrize(
    "cure",
    [
        "check the input",
        "Check your file.",
        "try again",
        "fix the file",
        "fix it",
        "use a valid value",
        "see the documentation",
    ],
)
def test_generic_phrases_are_known(cure):
    assert GENERIC.fullmatch(cure)


@pytest.mark.parametrize(
    "cure",
    [
        "run gdtool unwrap",
        "lower --size",
        "export it as glTF 2.0",
        "use --device cpu",
        "scale the mask to the size of the picture",
    ],
)
def test_cures_that_say_something_are_not_taken_for_generic(cure):
    assert not GENERIC.fullmatch(cure)


def faults_of_options(text, commands):
    """Return the options that a text names and that one of the commands lacks."""
    text = FOREIGN.sub("", text)
    wrong = []
    for name, rest in OTHER.findall(text):
        if name in COMMANDS:
            wrong += [
                f"gdtool {name} has no {option}" for option in OPTION.findall(rest) if option not in options_of(name)
            ]
    for option in OPTION.findall(OTHER.sub("", text)):
        wrong += [f"{command} has no {option}" for command in sorted(commands) if option not in options_of(command)]
    return wrong


def test_every_option_named_is_one_that_the_command_has():
    wrong = []
    for message in MESSAGES:
        allowed, commands = EXCEPTIONS.get((message.file, message.function), (set(), ""))[0], commands_of(message.file)
        for text in message.words():
            kept = OPTION.sub(lambda found, allowed=allowed: "" if found[0] in allowed else found[0], text)
            wrong += [(message.where, fault) for fault in faults_of_options(kept, commands)]
    assert not wrong, "\n".join(f"{where}: {fault}" for where, fault in wrong)


def test_an_option_of_another_command_is_found():
    assert faults_of_options("lower --size", {"train", "bake"}) == []
    assert faults_of_options("lower --size, or give --env", {"train", "relight"}) == ["train has no --env"]
    assert faults_of_options("run gdtool remesh --faces 10", {"train"}) == []
    assert faults_of_options("run gdtool remesh --steps 10", {"train"}) == ["gdtool remesh has no --steps"]
    assert faults_of_options("pip install --force-reinstall igl", {"train"}) == []


def test_rooms_are_reached_through_imports_and_child_functions():
    assert commands_of("gdtool/bake/usd.py") == {"bake"}
    assert commands_of("gdtool/stages/remesh.py") == {"remesh"}
    assert "unwrap" in commands_of("gdtool/unwrap/parameterize/schedule.py")
    assert commands_of("gdtool/core/errors.py") == set(COMMANDS)
    for (file, function), (allowed, reason) in EXCEPTIONS.items():
        assert allowed, f"{file}: {function} is gone"
        assert reason, f"{file}: {function} is gone"
        assert any(one.name == function for one in functions(FILES[file])), f"{file}: {function} is gone"
