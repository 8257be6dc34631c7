"""Compiled code is found again by all that it follows from, and processes that write at once keep both."""

from __future__ import annotations

import threading
from pathlib import Path

from caphy.jit import ROOT, CacheFile, followed


def test_other_constants_of_another_file_are_other_code(tmp_path: Path) -> None:
    """numba's own stamp is of the kernel's file alone: Hessians went on by constants of before an edit."""
    for folder in ("one", "two"):
        package = tmp_path / folder / "pack"
        (package / "deep").mkdir(parents=True)
        (package / "__init__.py").write_text("")
        (package / "deep" / "__init__.py").write_text("")
        (package / "kernels.py").write_text("import numpy\nfrom pack.deep import law\n")
        (package / "deep" / "law.py").write_text("def f():\n    from pack.constants import FAR\n")
        (package / "constants.py").write_text("FAR = 1\n" if folder == "one" else "FAR = 2\n")
        (package / "other.py").write_text(folder)
    one, two = (
        followed(tmp_path / folder / "pack" / "kernels.py", tmp_path / folder / "pack") for folder in ("one", "two")
    )
    assert one != two
    names = [followed(tmp_path / folder / "pack" / "other.py", tmp_path / folder / "pack") for folder in ("one", "two")]
    assert names[0] != names[1]
    assert followed(ROOT / "effects" / "kernels.py") != followed(ROOT / "solve" / "factor_kernels.py")


def test_what_older_code_compiled_is_not_found(tmp_path: Path) -> None:
    old, new = (CacheFile(str(tmp_path), "loop-1", ("stamp", digest)) for digest in ("before", "after"))
    old.save("float64", "old code")
    assert old.load("float64") == "old code" and new.load("float64") is None
    new.save("float64", "new code")
    assert new.load("float64") == "new code" and old.load("float64") is None


def test_two_processes_that_compile_at_once_keep_both(tmp_path: Path, monkeypatch) -> None:
    """Both took the same file's name, and one type's code was found by the other's."""
    first, second = (CacheFile(str(tmp_path), "loop-1", "stamp") for _ in range(2))
    writing, go_on = threading.Event(), threading.Event()
    save_data = first._save_data

    def slowly(name: str, data: object) -> None:
        writing.set()
        go_on.wait(0.3)
        save_data(name, data)

    monkeypatch.setattr(first, "_save_data", slowly)
    one = threading.Thread(target=first.save, args=("float64", "of doubles"))
    two = threading.Thread(target=second.save, args=("float32", "of floats"))
    one.start()
    writing.wait()
    two.start()
    one.join()
    two.join()
    assert (first.load("float64"), first.load("float32")) == ("of doubles", "of floats")
    assert len(list(tmp_path.glob("*.nbc"))) == 2


def test_an_index_never_names_what_is_not_written_yet(tmp_path: Path, monkeypatch) -> None:
    kept = CacheFile(str(tmp_path), "loop-1", "stamp")
    seen = []
    monkeypatch.setattr(kept, "_save_data", lambda name, data: seen.append(kept._load_index()))
    kept.save("float64", "code")
    assert seen == [{}]
