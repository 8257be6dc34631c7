"""``python -m caphy``."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

import caphy
from caphy import commands
from caphy.cli import LISTS, main


def test_the_package_runs_as_the_command_does() -> None:
    ran = [
        subprocess.run([sys.executable, "-m", "caphy", *words], capture_output=True, text=True, check=False)
        for words in (["--help"], ["fly"])
    ]
    assert ran[0].returncode == 0 and "usage: caphy COMMAND" in ran[0].stdout
    assert ran[1].returncode == 2 and "there is no command 'fly'" in ran[1].stderr


def test_it_tells_its_version(capsys) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"caphy {caphy.__version__}\n"


@pytest.mark.parametrize("again", [["--base", "c.npz"], ["--base=c.npz"]])
def test_an_option_given_twice_is_refused(again, capsys) -> None:
    """The last one alone would count."""
    assert main(["diagnose", "snug", "a.npz", "--base", "b.npz", *again, "-o", "out"]) == 2
    assert "caphy diagnose: --base is given twice; give all its values after one --base" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words",
    [
        "body build", "body render", "poses convert", "poses condition", "poses render", "garment make tshirt",
        "garment from-mesh", "garment render", "register body", "register garments", "register points", "effects new",
        "simulate", "scans render", "scans from-4d-dress", "segment", "train", "collide", "compare", "diagnose",
        "refit", "challenge new", "evaluate", "fit", "export", "demo",
    ],
)  # fmt: skip
def test_where_a_command_writes_has_the_same_names_in_all(words, capsys) -> None:
    with pytest.raises(SystemExit):
        main([*words.split(), "--help"])
    told = re.findall(r"(?<= )--?o[a-z]* ", capsys.readouterr().out)
    assert {"-o ", "--out ", "--output "} <= set(told)


@pytest.mark.parametrize(
    ("command", "option", "choices"),
    [
        ("fabric run", "--objective", "response force"),
        ("fabric run", "--garments", "upper lower"),
        ("register garments scans -o run", "--garments", "upper lower"),
        ("register garments scans -o run", "--kinds", "upper lower"),
        ("train tshirt -o run", "--device", "cpu cuda"),
    ],
)
def test_what_may_be_chosen_is_told(command, option, choices, capsys) -> None:
    with pytest.raises(SystemExit, match="0"):
        main([*command.split(), "--help"])
    assert "{" + choices.replace(" ", ",") + "}" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="2"):
        main([*command.split(), option, "hat"])
    assert set(choices.split()) <= set(re.findall(r"\w+", capsys.readouterr().err))


@pytest.mark.parametrize(
    ("command", "told"),
    [
        ("garment info", ["as 'caphy garment make' and 'from-mesh' write it"]),
        ("garment check", ["the mesh", "an SMPL-X-format npz", "shape coefficients"]),
        ("scans check", ["folder with a scans.toml"]),
    ],
)
def test_help_says_what_to_give(command, told, capsys) -> None:
    with pytest.raises(SystemExit, match="0"):
        main([*command.split(), "--help"])
    said = capsys.readouterr().out
    assert all(words in said for words in told)


def test_they_are_all_options_with_any_number_of_values() -> None:
    sources = "\n".join(path.read_text() for path in Path(commands.__file__).parent.glob("*.py"))
    lists = re.findall(r"^    (\w+): (?:tuple\[[^\n]*, \.\.\.\]|EffectFiles) = ", sources, re.MULTILINE)
    others = re.findall(r'tuple\[[^\n]*aliases=\["(--\w+)"\]', sources)
    assert {*others, *(f"--{name.replace('_', '-')}" for name in lists)} == set(LISTS)
