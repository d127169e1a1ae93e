"""Check each command's help, options, exit codes and streams."""

import importlib
import json
import re

import pytest

from gdtool.commands import COMMANDS

REPORTS = ("evaluate", "validate")  # print a report and write no folder
STAGES = [name for name in COMMANDS if name not in REPORTS]


def command_of(name):
    return importlib.import_module("gdtool.commands." + name.replace("-", "_")).command


def options_of(name):
    return {option: param for param in command_of(name).params for option in (*param.opts, *param.secondary_opts)}


@pytest.mark.parametrize("name", COMMANDS)
def test_help_has_a_description_and_an_example(gdtool_here, name):
    done = gdtool_here(name, "--help")
    assert done.returncode == 0
    assert done.stderr == ""
    assert f"gdtool {name}" in done.stdout
    assert "Example" in done.stdout


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_has_a_help_text_in_one_style(name):
    for param in command_of(name).params:
        text = getattr(param, "help", None)
        if param.param_type_name == "option":
            assert text, f"{param.opts} says nothing"
            assert "  " not in text, f"{param.opts}: {text}"


@pytest.mark.parametrize("name", STAGES)
def test_every_stage_has_the_common_options(name):
    wanted = {
        "-o",
        "--output",
        "-n",
        "--dry-run",
        "-f",
        "--force",
        "--json",
        "--threads",
        "--log-file",
        "-q",
        "-v",
        "--debug",
    }
    assert wanted <= set(options_of(name))


@pytest.mark.parametrize("name", STAGES)
def test_a_device_is_chosen_where_networks_run(name):
    assert ("--device" in options_of(name)) == (name in ("train", "sample-views", "reconstruct", "bake"))


@pytest.mark.parametrize("name", REPORTS)
def test_every_report_has_the_common_options(name):
    assert {"--json", "--log-file", "-q", "-v", "--debug"} <= set(options_of(name))


@pytest.mark.parametrize("name", COMMANDS)
def test_an_unknown_option_is_a_usage_error_in_one_line(gdtool_here, name):
    done = gdtool_here(name, "--no-such-option")
    assert done.returncode == 2
    assert done.stdout == ""
    assert re.fullmatch(rf"gdtool {name}: no such option '--no-such-option'.*; see gdtool {name} --help\n", done.stderr)


@pytest.mark.parametrize("name", COMMANDS)
def test_a_source_that_is_missing_is_named(gdtool_here, name):
    done = gdtool_here(name, "nothing/here")
    assert done.returncode == 3
    assert done.stdout == ""
    assert re.match(r"gdtool: .*nothing/here.* does not exist; ", done.stderr), done.stderr


@pytest.mark.parametrize("name", COMMANDS)
def test_no_sources_is_a_usage_error(gdtool_here, name):
    done = gdtool_here(name, stdin="")
    assert done.returncode == 2
    assert "gave no sources" in done.stderr


def test_stdout_has_the_folder_and_nothing_else(gdtool, tmp_path):
    done = gdtool("render-dataset", "procedural:1", "--size", 16, "--samples", 4, "-o", "out", "-v")
    assert done.returncode == 0, done.stderr
    assert done.stdout == "out\n"
    assert "render" in done.stderr


def test_json_prints_one_object_per_source(gdtool):
    done = gdtool("render-dataset", "procedural:1", "--size", 16, "--samples", 4, "-o", "out", "--json", "-q")
    record = json.loads(done.stdout)
    assert record["folder"] == "out"
    assert record["kind"] == "views"
    assert record["status"] == "done"
    assert done.stderr == ""


def test_a_dry_run_writes_nothing(gdtool, tmp_path):
    done = gdtool("render-dataset", "procedural:1", "-o", "out", "--dry-run")
    assert done.returncode == 0
    assert not (tmp_path / "out").exists()


def test_the_log_file_has_every_line_with_its_time(gdtool, tmp_path):
    for _ in range(2):
        done = gdtool(
            "render-dataset", "procedural:1", "--size", 16, "--samples", 4, "-o", "out", "-q", "--log-file", "log"
        )
        assert done.stderr == ""
    lines = (tmp_path / "log").read_text().splitlines()
    assert all(re.match(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}[+-]\d\d:\d\d ", line) for line in lines)
    assert sum("done in" in line for line in lines) == 1
    assert sum("up to date" in line for line in lines) == 1


def test_a_log_file_that_cannot_be_written_is_an_error_before_any_work(gdtool, tmp_path):
    done = gdtool("render-dataset", "procedural:1", "-o", "out", "--log-file", "no/such/folder")
    assert done.returncode == 4
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "words, expected", [("gdtool rem", "remesh"), ("gdtool remesh --fa", "--faces"), ("gdtool relight --light s", "sg")]
)
def test_the_shell_completes_commands_options_and_values(gdtool, monkeypatch, words, expected):
    monkeypatch.setenv("_GDTOOL_COMPLETE", "bash_complete")
    monkeypatch.setenv("COMP_WORDS", words)
    monkeypatch.setenv("COMP_CWORD", str(len(words.split()) - 1))
    done = gdtool()
    assert f"plain,{expected}" in done.stdout.splitlines()


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_completion_script_of_a_shell(gdtool, monkeypatch, shell):
    monkeypatch.setenv("_GDTOOL_COMPLETE", f"{shell}_source")
    done = gdtool()
    assert done.returncode == 0
    assert "_GDTOOL_COMPLETE" in done.stdout
