"""Building the example FMUs: the archive, the cache, the command line, what goes wrong."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from xml.etree import ElementTree

import pytest

fmpy = pytest.importorskip("fmpy")

from fmpy.validation import validate_fmu  # noqa: E402

from ctmhe.errors import FmuError, InputError, MissingExtra  # noqa: E402
from fmus import build as building  # noqa: E402
from fmus.build import build, main  # noqa: E402
from fmus.models import MODELS  # noqa: E402

CASES = [(name, fmi) for name, model in MODELS.items() for fmi in model.versions]


@contextmanager
def no_compiler_may_run():
    def refuse(*_):
        raise AssertionError("a compiler was run")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(building, "_pack", refuse)
        yield


@pytest.mark.parametrize(("name", "fmi"), CASES)
def test_fmu_is_valid(name, fmi):
    """The description obeys the standard's schema and rules, as fmpy checks them: no trap is in the XML's form."""
    assert validate_fmu(str(build(name, fmi))) == []


@pytest.mark.parametrize(("name", "fmi"), CASES)
def test_sources_travel_with_the_fmu(name, fmi):
    """Every source that the archive names is in it: in modelDescription.xml (FMI 2), buildDescription.xml (FMI 3)."""
    with zipfile.ZipFile(build(name, fmi)) as archive:
        path = "modelDescription.xml" if fmi == 2 else "sources/buildDescription.xml"
        root = ElementTree.fromstring(archive.read(path))
        files = {f.get("name") for f in root.iter("File" if fmi == 2 else "SourceFile")}
        assert files >= {f"fmi{fmi}.c", "core.c", "step.c"}
        assert {f"sources/{name}" for name in files} <= set(archive.namelist())


def test_building_twice_compiles_once():
    """The second call returns the same file without touching a compiler."""
    first = build("batch_reactor", 2)
    changed = first.stat().st_mtime_ns
    with no_compiler_may_run():
        assert build("batch_reactor", 2) == first
    assert first.stat().st_mtime_ns == changed
    assert first.name == "batch_reactor_fmi2.fmu"


def test_concurrent_builds_give_the_same_bytes(tmp_path, monkeypatch):
    """Several builders of one FMU into an empty cache end with one whole file; its bytes are reproducible."""
    monkeypatch.setattr(building, "_cache", lambda: tmp_path / "cache")
    with ThreadPoolExecutor(4) as pool:
        paths = list(pool.map(lambda _: build("van_der_pol", 3), range(4)))
    assert len(set(paths)) == 1
    assert [p.name for p in paths[0].parent.iterdir()] == ["van_der_pol_fmi3.fmu"]
    first = paths[0].read_bytes()
    paths[0].unlink()
    assert build("van_der_pol", 3).read_bytes() == first


def test_command_line_prints_the_files(tmp_path, capsys):
    """`python -m fmus.build NAME --out DIR --fmi 3` puts the FMU into DIR and prints its path."""
    assert main(["batch_reactor", "--out", str(tmp_path), "--fmi", "3"]) == 0
    path = tmp_path / "batch_reactor_fmi3.fmu"
    assert capsys.readouterr().out.split() == [str(path)]
    assert zipfile.is_zipfile(path)


def test_errors_say_what_to_do(monkeypatch, tmp_path):
    """An unknown name or version, no compiler and no fmpy each end in an error that names the remedy."""
    with pytest.raises(InputError, match=r"'reactor'.*batch_reactor"):
        build("reactor")
    with pytest.raises(InputError, match="choose 2 or 3"):
        build("batch_reactor", 1)
    monkeypatch.setattr(building, "_cache", lambda: tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(building, "find_spec", lambda _: None)
        with pytest.raises(MissingExtra, match=r"ctmhe\[fmu\]"):
            build("batch_reactor")
    with monkeypatch.context() as patch:
        patch.setattr(building, "FLAGS", ("-no-such-flag",))
        with pytest.raises(FmuError, match=r"failed on batch_reactor \(FMI 2\)"):
            build("batch_reactor")
    monkeypatch.setattr(building, "find_compiler", lambda: None)
    with pytest.raises(FmuError, match="build-essential"):
        build("batch_reactor")


def test_what_needs_fmi_3_is_not_built_as_fmi_2(capsys):
    """Arrays and structural parameters do not exist in FMI 2, and the error says where they do."""
    for name in ("arrays", "structural"):
        with pytest.raises(InputError, match=f"{name} exists in FMI 3 only"):
            build(name, 2)
        assert main([name, "--fmi", "2"]) == 1
        assert "FMI 3 only" in capsys.readouterr().err
    assert main(["arrays"]) == 0
    assert capsys.readouterr().out.split() == [str(build("arrays", 3))]


def test_building_does_not_import_fmpy():
    """fmpy is only looked up for its headers: building stays light."""
    code = "import sys, fmus.build as b; b.build('batch_reactor'); sys.exit('fmpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
