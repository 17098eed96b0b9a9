"""Pages say what is so: links lead somewhere, and every command is one that the command line takes."""

import functools
import re
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import tyro

from illuminerf import cli

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
SHELL_WORDS = ("#", "|", "&&", "&", ";", ">", "||")


def without_code(text: str) -> str:
    return re.sub(r"`[^`\n]*`", "", re.sub(r"^```.*?^```", "", text, flags=re.M | re.S))


def links(page: Path) -> list[str]:
    return re.findall(r"\]\(([^)\s]+)\)", without_code(page.read_text()))


def anchors(page: Path) -> set[str]:
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.M | re.S)
    titles = re.findall(r"^#+ (.+)$", text, flags=re.M)
    return {re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", title).strip().lower()) for title in titles}


def broken(page: Path, link: str) -> str | None:
    """What is wrong with a link, or None."""
    if re.match(r"[a-z]+:", link):
        return None
    path, _, anchor = link.partition("#")
    target = (page.parent / path).resolve() if path else page
    if not target.exists():
        return f"{page.name}: {link} is missing"
    if page.parent.name == "docs" and not target.is_relative_to(page.parent):
        return f"{page.name}: {link} is outside of the site"
    if anchor and anchor not in anchors(target):
        return f"{page.name}: {link} is no heading"
    return None


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    assert [said for link in links(page) if (said := broken(page, link))] == []


def test_a_broken_link_is_found() -> None:
    page = ROOT / "docs" / "index.md"
    assert broken(page, "nowhere.md") and broken(page, "conventions.md#nothing") and broken(page, "../README.md")
    assert broken(page, "conventions.md#light") is None and len(links(page)) > 3


def test_every_page_is_in_the_navigation() -> None:
    named = set(re.findall(r"([\w.-]+\.md)", (ROOT / "mkdocs.yml").read_text()))
    assert named == {page.name for page in PAGES[1:]}


def commands(page: Path) -> list[list[str]]:
    """The arguments of every `illuminerf ...` line in the page's shell blocks."""
    found = []
    for block in re.findall(r"^```(?:bash|sh|console)\n(.*?)^```", page.read_text(), flags=re.M | re.S):
        for line in block.replace("\\\n", " ").splitlines():
            words = shlex.split(line.removeprefix("$ ").strip(), comments=True)
            if words[:1] == ["illuminerf"]:
                end = next((i for i, word in enumerate(words) if word in SHELL_WORDS), len(words))
                found.append(words[1:end])
    return found


def idle(command: Any) -> Any:
    """A command with the same options that does nothing."""
    if isinstance(command, type):
        return command

    @functools.wraps(command)
    def nothing(*_: Any, **__: Any) -> None:
        return None

    return nothing


def parse(arguments: list[str]) -> None:
    """Parse as `illuminerf` does, and run nothing; SystemExit where it would refuse."""
    table: dict[str, Callable[..., Any]] = cli.COMMANDS
    if arguments[0] in cli.GROUPS:
        table, arguments = cli.GROUPS[arguments[0]], arguments[1:]
    chosen = {name: idle(command) for name, command in table.items() if name in arguments[:1]}
    if not chosen:
        raise SystemExit(f"no subcommand {arguments[:1]}")
    chosen["none"] = lambda: None  # one subcommand alone would not be named
    tyro.extras.subcommand_cli_from_dict(chosen, args=arguments)


EVERY = [(page.name, arguments) for page in PAGES for arguments in commands(page)]


@pytest.mark.parametrize(("page", "arguments"), EVERY, ids=[f"{page}:{' '.join(a)[:60]}" for page, a in EVERY])
def test_commands_are_what_the_command_line_takes(page: str, arguments: list[str]) -> None:
    parse(arguments)


def test_an_option_that_does_not_exist_is_found(capsys: pytest.CaptureFixture[str]) -> None:
    assert len(EVERY) > 25
    with pytest.raises(SystemExit):
        parse(["relight", "PHOTOS", "--light", "a.exr", "--out", "run", "--shiny"])
    with pytest.raises(SystemExit):
        parse(["polish"])


def test_commands_named_in_sentences_exist() -> None:
    known = set(cli.COMMANDS) | set(cli.GROUPS) | {f"{g} {n}" for g, names in cli.GROUPS.items() for n in names}
    for page in PAGES:
        for words in re.findall(r"`illuminerf ([a-z][\w -]*)", page.read_text()):
            first = words.split()[:2]
            assert {first[0], " ".join(first)} & known, f"{page.name}: illuminerf {words}"
            if first[0] in cli.GROUPS and len(first) > 1 and not first[1].startswith("-"):
                assert " ".join(first) in known, f"{page.name}: illuminerf {words}"


CHEAP = [["presets"], ["models", "list"], ["models", "info", "dilightnet"]]


@pytest.mark.parametrize("arguments", CHEAP, ids=" ".join)
def test_cheap_commands_run(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    cli.main(arguments)
    assert "dilightnet" in "".join(capsys.readouterr())


@pytest.mark.slow
def test_the_site_builds_strictly(tmp_path: Path) -> None:
    config = pytest.importorskip("mkdocs.config")
    pytest.importorskip("mkdocstrings")
    build = pytest.importorskip("mkdocs.commands.build")
    loaded = config.load_config(str(ROOT / "mkdocs.yml"), site_dir=str(tmp_path / "site"), strict=True)
    build.build(loaded)
    assert "RunFolder" in (tmp_path / "site" / "api" / "index.html").read_text()
