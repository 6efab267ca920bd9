"""An FMU that carries its sources is compiled here, and is then the FMU that its maker would have compiled."""

import os
import stat
import tempfile
import zipfile
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

pytest.importorskip("fmpy")

from ctmhe.cli import app
from ctmhe.errors import FmuArchiveError, FmuBinaryError, InputError
from ctmhe.models.fmu import FmuModel
from ctmhe.models.fmu import building as building_module
from ctmhe.models.fmu.archive import Unpacked
from ctmhe.models.fmu.building import build
from ctmhe.models.fmu.description import platform_folder
from ctmhe.models.fmu.reading import read_description
from fmus.build import build as bundled
from tests.models.damaged import rewritten


def without_binary(fmi: int, target: Path, name: str = "van_der_pol", **changes) -> Path:
    return rewritten(bundled(name, fmi=fmi), target, keep=lambda entry: not entry.startswith("binaries/"), **changes)


def entries(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        assert archive.testzip() is None
        return {entry.filename: archive.read(entry) for entry in archive.infolist()}


@pytest.fixture
def quiet(tmp_path, monkeypatch) -> Path:
    """A folder for temporary files that must be empty afterwards."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


@pytest.mark.parametrize("fmi", [2, 3])
def test_the_compiled_fmu_is_the_original_again(fmi, tmp_path, quiet):
    """Same derivatives and outputs as the FMU that came with its binary; all else in the archive as it was."""
    source = without_binary(fmi, tmp_path / "source.fmu", add=(("binaries/other-platform/x.so", b"kept"),))
    before = source.read_bytes()
    made = build(source, tmp_path / "made.fmu")
    assert made == tmp_path / "made.fmu" and source.read_bytes() == before
    binary = f"binaries/{platform_folder(fmi)}/van_der_pol"
    new = {name: data for name, data in entries(made).items() if not name.endswith("/")}
    added = set(new) - set(entries(source))
    assert len(added) == 1 and added.pop().startswith(binary)
    assert {name: new[name] for name in entries(source)} == entries(source)
    x, p = np.array([1.3, -0.4]), np.array([1.5])
    values = []
    for path in (made, bundled("van_der_pol", fmi=fmi)):
        model = FmuModel(path, inputs=[], parameters=["mu"])
        values.append(np.array(model.dynamics(0.0, x, [], [0, 0], p)).ravel())
        model.close()
    np.testing.assert_allclose(values[0], values[1], rtol=1e-14)
    np.testing.assert_allclose(values[0], [x[1], p[0] * (1 - x[0] ** 2) * x[1] - x[0]], rtol=1e-14)
    assert list(quiet.iterdir()) == []
    assert sorted(path.name for path in tmp_path.iterdir()) == ["made.fmu", "source.fmu", "temporary"]


def test_where_the_result_goes(tmp_path):
    """Beside the source with the platform in its name, or over the source only when that is asked for."""
    source = without_binary(2, tmp_path / "source.fmu")
    before = source.read_bytes()
    made = build(source)
    assert made == tmp_path / f"source_{platform_folder(2)}.fmu" and source.read_bytes() == before
    assert build(source, source) == source and entries(source) == entries(made)
    assert build(source, made) == made  # an FMU that has a binary already gets a new one
    with pytest.raises(InputError, match="is a folder"):
        build(source, tmp_path)
    with pytest.raises(InputError, match="no folder"):
        build(source, tmp_path / "nowhere" / "x.fmu")


def test_a_read_only_source_is_compiled_elsewhere(tmp_path):
    """Nothing is written beside it."""
    folder = tmp_path / "readonly"
    folder.mkdir()
    source = without_binary(2, folder / "source.fmu")
    source.chmod(0o400)
    folder.chmod(0o500)
    try:
        made = build(source, tmp_path / "made.fmu")
        assert os.listdir(folder) == ["source.fmu"] and made.is_file()
        assert stat.S_IMODE(made.stat().st_mode) == 0o644
    finally:
        folder.chmod(0o700)


def test_what_the_compiler_says_is_told(tmp_path, quiet):
    """File, line and reason; the old target stays and nothing else does."""
    target = tmp_path / "made.fmu"
    target.write_bytes(b"older")

    def broken(name: str, data: bytes) -> bytes:
        return data + b"\nint broken = no_such_thing;\n" if name.endswith("core.c") else data

    with pytest.raises(FmuBinaryError, match=r"core\.c:\d+.*\n?.*no_such_thing"):
        build(without_binary(2, tmp_path / "source.fmu", alter=broken), target)

    def unfinished(name: str, data: bytes) -> bytes:
        return data + b"\nint lost(void); int found(void) { return lost(); }\n" if name.endswith("core.c") else data

    with pytest.raises(FmuBinaryError, match="lost"):
        build(without_binary(2, tmp_path / "source.fmu", alter=unfinished), target)
    assert target.read_bytes() == b"older"
    assert list(quiet.iterdir()) == []
    assert sorted(path.name for path in tmp_path.iterdir()) == ["made.fmu", "source.fmu", "temporary"]


def test_a_binary_that_does_not_run_is_not_kept(tmp_path):
    """The result is tried before it takes its place: here its identity is not that of the description."""
    source = without_binary(2, tmp_path / "source.fmu", change=lambda text: text.replace('guid="{', 'guid="{0'))
    with pytest.raises(FmuBinaryError, match="compiled but cannot be used"):
        build(source, tmp_path / "made.fmu")
    assert [path.name for path in tmp_path.iterdir()] == ["source.fmu"]


def test_without_sources_or_compiler_the_message_says_so(tmp_path, monkeypatch):
    """None listed, listed but missing, in another language, and no compiler to be found."""

    def fmi3(name: str, old: str, new: str) -> Path:
        def alter(entry: str, data: bytes) -> bytes:
            return data.replace(old.encode(), new.encode()) if entry.endswith("buildDescription.xml") else data

        return without_binary(3, tmp_path / name, alter=alter)

    none = rewritten(bundled("van_der_pol", fmi=3), tmp_path / "a.fmu", keep=lambda name: "sources" not in name)
    for path, told in (
        (none, "carries no C sources"),
        (fmi3("b.fmu", '<SourceFile name="core.c" />', '<SourceFile name="lost.c" />'), r"'lost\.c'"),
        (fmi3("c.fmu", 'language="C99"', 'language="C++11"'), r"C\+\+11; only C"),
        (fmi3("d.fmu", 'modelIdentifier="van_der_pol"', 'modelIdentifier="other"'), "carries no C sources"),
    ):
        with pytest.raises(FmuBinaryError, match=told):
            build(path, tmp_path / "made.fmu")
    monkeypatch.setattr(building_module, "find_compiler", lambda: None)
    with pytest.raises(FmuBinaryError, match="without a C compiler"):
        build(without_binary(2, tmp_path / "e.fmu"), tmp_path / "made.fmu")
    assert not (tmp_path / "made.fmu").exists()


def test_macros_and_include_folders_of_a_build_description_count(tmp_path):
    """Without the macro, or the folder of the header, these sources do not compile."""
    extra = "<PreprocessorDefinition name='FACTOR' value='2.5'/><PreprocessorDefinition name='PLAIN'/>"
    extra += "<PreprocessorDefinition name='ABSENT' optional='true'/><IncludeDirectory name='deep/er'/>"
    check = b"""
#include "own.h"
#if !defined(FACTOR) || !defined(PLAIN) || defined(ABSENT) || OWN != 3
#error "not as described"
#endif
double as_described(void) { return FACTOR; }
"""

    def alter(name: str, data: bytes) -> bytes:
        if name.endswith("buildDescription.xml"):
            return data.replace(b"</SourceFileSet>", extra.encode() + b"</SourceFileSet>")
        return data + check if name.endswith("core.c") else data

    own = ("sources/deep/er/own.h", b"#define OWN 3\n")
    build(without_binary(3, tmp_path / "source.fmu", alter=alter, add=(own,)), tmp_path / "made.fmu")
    archive = Unpacked(tmp_path / "made.fmu")
    sources = read_description(archive.folder).sources["ModelExchange"][0]
    archive.close()
    assert sources.defines == (("FACTOR", "2.5"), ("PLAIN", "")) and sources.includes == ("deep/er",)
    extra = "<PreprocessorDefinition name='a b; rm'/>"
    with pytest.raises(FmuArchiveError, match="name of a macro"):
        build(without_binary(3, tmp_path / "evil.fmu", alter=alter), tmp_path / "made.fmu")


@pytest.mark.parametrize("fmi", [2, 3])
def test_the_command_line_compiles(fmi, tmp_path):
    """`ctmhe fmu build FILE --out FILE`, then `info` finds this platform."""
    source = without_binary(fmi, tmp_path / "source.fmu")
    made = CliRunner().invoke(app, ["fmu", "build", str(source), "--out", str(tmp_path / "made.fmu")])
    assert made.exit_code == 0 and "written" in made.output
    assert "(this platform)" in CliRunner().invoke(app, ["fmu", "info", str(tmp_path / "made.fmu")]).output
