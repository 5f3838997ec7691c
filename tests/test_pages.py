"""What README.md and docs/ show runs, and prints what they show; the links of the README work."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from pages import PAGES, PageError, name_of, rewritten, run_page
from places import REPOSITORY

import lae_sim

GOOD = """
# A page

```toml title="study.toml"
traces = ["traces/synthetic-slow.parquet"]
```

```console
$ cat study.toml | head -1
traces = ["..."]
$ lae-sim show nothing.parquet
lae-sim show: error: nothing.parquet: ...
$ lae-sim replay traces/synthetic-slow.parquet \\
    --sequence car-chase
...
traces/synthetic-slow.parquet: slow-and-accurate, ...
...
```

- In a list:

  ```python
  word = "answer"
  ```

  ```pycon
  >>> word
  'an...'
  ```

<!-- not run: needs a Jetson -->
```sh
sudo nvpmodel -m 0
```
"""


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_page_prints_what_it_shows(page: Path, tmp_path: Path) -> None:
    differences = run_page(page, tmp_path)
    assert not differences, "\n\n".join(each.describe(name_of(page)) for each in differences)


@pytest.fixture
def page(tmp_path: Path) -> Path:
    return tmp_path / "page.md"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "run").mkdir()
    return tmp_path / "run"


def test_a_good_page_is_good(page: Path, folder: Path) -> None:
    page.write_text(GOOD)
    assert run_page(page, folder) == []


def test_what_is_printed_otherwise_is_shown_with_its_line(page: Path, folder: Path) -> None:
    page.write_text("Text\n\n```console\n$ printf 'a\\nb\\n'\na\nc\n$ echo d\nd\n```\n")
    (difference,) = run_page(page, folder)
    assert difference.describe("page.md").splitlines() == [
        "page.md:5: $ printf 'a\\nb\\n'",
        "--- the page",
        "+++ printed",
        "@@ -1,2 +1,2 @@",
        " a",
        "-c",
        "+b",
    ]


def test_outputs_are_written_into_the_page(page: Path, folder: Path) -> None:
    page.write_text("- x\n\n  ```console\n  $ printf '1\\n2\\n'\n  0\n  $ echo 3\n  ...\n  ```\n")
    written = rewritten(page.read_text(), run_page(page, folder))
    shown = ["  $ printf '1\\n2\\n'", "  1", "  2", "  $ echo 3", "  ..."]
    assert written.splitlines()[3:-1] == shown


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("```console\n$ lae-sim show nothing.parquet\n```", r"page.md:2: exit status 2"),
        ("```console\nlae-sim show\n```", "no command"),
        ("```python\nx = 1\n1 / 0\n```", r"page.md:3: ZeroDivisionError"),
        ("```pycon\n>>> 1 + 1\n3\n```", r"page.md:2:(.|\n)*Got:\n +2"),
        ("```sh\nls\n```", "not run: REASON"),
        ("```\nls\n```", "no language"),
        ("```bash\nls\n```", "bash: name one that is run"),
        ("```json\n{}\n", "line 1: the block never ends"),
    ],
)
def test_a_snippet_that_fails_or_is_not_run_is_an_error(
    text: str, said: str, page: Path, folder: Path
) -> None:
    page.write_text(text)
    with pytest.raises(PageError, match=said):
        run_page(page, folder)


def test_links_of_the_readme_lead_to_files_and_headings() -> None:
    for target in re.findall(r"\]\((?!https?:)([^)\s]+)\)", (REPOSITORY / "README.md").read_text()):
        path, _, anchor = target.partition("#")
        assert (REPOSITORY / (path or "README.md")).exists(), target
        if anchor:
            text = (REPOSITORY / (path or "README.md")).read_text()
            assert anchor in {slug(each) for each in re.findall(r"^#+ (.+)$", text, re.M)}, target


def slug(heading: str) -> str:
    """The anchor that Markdown's toc, and GitHub alike, makes of a heading of plain words."""
    return re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", heading).strip().lower())


def test_every_name_of_the_package_is_in_the_reference() -> None:
    page = (REPOSITORY / "docs" / "reference" / "api.md").read_text()
    named = re.findall(r"^::: lae_sim\.(\w+)$", page, re.M)
    assert sorted(named) == sorted(lae_sim.__all__)
