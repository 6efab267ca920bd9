"""An archive is unpacked into a private folder, or refused by name; nothing else is ever written."""

import gc
import hashlib
import os
import stat
import subprocess
import sys
import tempfile
import warnings
import zipfile
import zlib
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ctmhe.errors import FmuArchiveError, FmuError
from ctmhe.models.fmu import archive as archive_module
from ctmhe.models.fmu.archive import Unpacked
from ctmhe.models.fmu.reading import read_description
from fmus.build import build
from tests.models.damaged import OPENS, damaged, rewritten, with_central_field


@pytest.fixture(scope="module")
def fmu() -> Path:
    return build("van_der_pol", fmi=2)


@pytest.fixture(scope="module")
def collection(tmp_path_factory):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # zipfile: duplicate name
        return damaged(tmp_path_factory.mktemp("damaged"))


@pytest.fixture
def private(tmp_path, monkeypatch) -> Path:
    """The folder for temporary files, empty, inside another that a traversal would write into."""
    folder = tmp_path / "outer" / "private"
    folder.mkdir(parents=True)
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    monkeypatch.chdir(tmp_path / "outer")
    return folder


def open_and_read(path: Path) -> None:
    archive = Unpacked(path)
    try:
        read_description(archive.folder)
    finally:
        archive.close()


def with_entries(source: Path, target: Path, *entries) -> Path:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return rewritten(source, target, add=entries)


def test_every_damaged_fmu_is_refused_with_its_error_and_leaves_nothing(collection, private):
    """The class is the promised one, the temporary folder is empty again, nothing is beside it."""
    for name, (path, error) in collection.items():
        before = path.read_bytes()
        if name in OPENS:
            open_and_read(path)
        else:
            with pytest.raises(FmuError) as caught:
                open_and_read(path)
            assert type(caught.value) is error, name
        assert [p.name for p in private.parent.rglob("*")] == ["private"], name
        assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("name", "entry"),
    [
        ("traversal", "../../evil.txt"),
        ("absolute", "/tmp/evil.txt"),
        ("drive", "C:/evil.txt"),
        ("backslash", "..\\evil.txt"),
        ("control character", "resources/a\x1bb.txt"),
        ("symlink", "resources/link"),
        ("device", "resources/device"),
        ("case", "MODELDESCRIPTION.xml"),
        ("file and folder", "resources/a/b"),
        ("bomb", "resources/zeros.bin"),
        ("checksum", "resources/unused.txt"),
        ("encrypted", "sources/core.c"),
        ("compression", "sources/core.c"),
    ],
)
def test_the_entry_that_is_refused_is_named(collection, name, entry):
    """Whoever made the FMU finds what to change."""
    with pytest.raises(FmuArchiveError) as caught:
        Unpacked(collection[name][0])
    assert repr(entry) in str(caught.value)


def test_names_that_hide_one_another_are_refused(fmu, tmp_path):
    """Twice the same, in another case, in another Unicode form, or with a dot that Windows drops."""
    for number, pair in enumerate(
        [("a", "a"), ("x/a", "X/b"), ("é", "e\u0301"), ("a", "a."), ("a", "./a"), ("d/", "d")]
    ):
        names = [f"resources/{name}" for name in pair]
        file = with_entries(fmu, tmp_path / f"{number}.fmu", *((name, b"") for name in names))
        with pytest.raises(FmuArchiveError, match="refused because"):
            Unpacked(file)


def test_a_null_character_in_a_name_is_refused(fmu, tmp_path):
    """What follows it would be cut off, and the name be another."""
    file = with_entries(fmu, tmp_path / "null.fmu", ("resources/aXb", b""))
    file.write_bytes(file.read_bytes().replace(b"resources/aXb", b"resources/a\0b"))
    with pytest.raises(FmuArchiveError, match="null character"):
        Unpacked(file)


def test_a_second_name_in_an_extra_field_cannot_leave_the_folder(fmu, tmp_path, private):
    """Info-ZIP's Unicode path replaces the name that everybody sees; it is judged too, where Python heeds it."""
    for number, second in enumerate((b"../../evil.txt", b"modelDescription.xml", b"/evil.txt")):
        entry = zipfile.ZipInfo("resources/good.txt")
        field = b"\x01" + zlib.crc32(b"resources/good.txt").to_bytes(4, "little") + second
        entry.extra = (0x7075).to_bytes(2, "little") + len(field).to_bytes(2, "little") + field
        file = with_entries(fmu, tmp_path / f"{number}.fmu", (entry, b"evil"))
        with zipfile.ZipFile(file) as archive:
            heeded = archive.infolist()[-1].filename != "resources/good.txt"
        if heeded:
            with pytest.raises(FmuArchiveError, match="refused"):
                Unpacked(file)
        else:
            Unpacked(file).close()
        assert [path.name for path in private.parent.rglob("*")] == ["private"]
        entry.filename = second.decode()  # as a Python that heeds it reads the archive
        assert (archive_module._reason(entry) is None) == (second == b"modelDescription.xml")


@pytest.mark.parametrize(
    ("cap", "value", "message"),
    [
        ("MAX_ENTRIES", 3, "more than the 3"),
        ("MAX_ENTRY", 1000, "larger than"),
        ("MAX_TOTAL", 30_000, "all entries together"),
        ("MAX_FILE", 1000, "larger than"),
        ("MAX_PATH", 10, "too long"),
    ],
)
def test_caps_hold(fmu, monkeypatch, private, cap, value, message):
    """Each cap alone stops an archive that passes all the others."""
    monkeypatch.setattr(archive_module, cap, value)
    with pytest.raises(FmuArchiveError, match=message):
        Unpacked(fmu)
    assert list(private.iterdir()) == []


def test_sizes_are_counted_not_believed(fmu, tmp_path):
    """An entry whose header states a smaller size than it has is damaged, not cut."""
    file = with_entries(fmu, tmp_path / "big.fmu", ("resources/big", bytes(5000)))
    liar = with_central_field(file, tmp_path / "liar.fmu", "resources/big", 24, 100)
    with pytest.raises(FmuArchiveError, match="resources/big"):
        Unpacked(liar)


def test_overlapping_entries_are_refused(fmu, tmp_path):
    """Entries that together claim more packed bytes than the file has share some: the trick of the largest bombs."""
    file = with_central_field(fmu, tmp_path / "overlap.fmu", "sources/core.c", 22, 100)  # upper half of the packed size
    with pytest.raises(FmuArchiveError, match="overlap"):
        Unpacked(file)


def test_what_is_no_file_is_refused(tmp_path):
    """A missing file, a folder, a pipe; each with its own words, and without waiting."""
    with pytest.raises(FmuArchiveError, match="no such FMU file"):
        Unpacked(tmp_path / "nowhere.fmu")
    with pytest.raises(FmuArchiveError, match="is a folder"):
        Unpacked(tmp_path)
    with pytest.raises(FmuArchiveError, match="~nobody-of-this-name"):
        Unpacked("~nobody-of-this-name/x.fmu")
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe")
        with pytest.raises(FmuArchiveError, match="pipe"):
            Unpacked(tmp_path / "pipe")


def test_an_unreadable_file_is_refused(fmu, tmp_path, monkeypatch):
    """The reason of the system is passed on; simulated, as the tests may run as root."""
    file = rewritten(fmu, tmp_path / "secret.fmu")
    real = Path.open

    def refuse(path, *arguments, **keywords):
        if path == file:
            raise PermissionError(13, "Permission denied")
        return real(path, *arguments, **keywords)

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(FmuArchiveError, match=r"secret\.fmu cannot be read: Permission denied"):
        Unpacked(file)


def test_a_full_disk_is_told_and_leaves_nothing(fmu, private, monkeypatch):
    """What the system says when the private folder cannot be written becomes the error."""

    def refuse(*arguments, **keywords):
        raise OSError(28, "No space left on device")

    for owner, name in ((Path, "mkdir"), (tempfile, "mkdtemp")):
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, refuse)
            with pytest.raises(FmuArchiveError, match="No space left"):
                Unpacked(fmu)
    assert list(private.iterdir()) == []


def test_contents_come_out_as_they_went_in(fmu, tmp_path):
    """Nested folders, empty ones and odd but harmless names included; the source may be read-only."""
    extra = {"resources/a/b/c/data.bin": bytes(range(256)) * 10, "resources/größe ä.txt": b"x", "resources/none": b""}
    file = with_entries(fmu, tmp_path / "rich.fmu", *extra.items(), ("resources/empty/", b""))
    file.chmod(0o400)
    archive = Unpacked(file)
    with zipfile.ZipFile(file) as original:
        for entry in original.infolist():
            place = archive.folder / entry.filename
            assert place.is_dir() if entry.is_dir() else place.read_bytes() == original.read(entry)
    assert archive.digest == hashlib.sha256(file.read_bytes()).hexdigest()
    assert not archive.folder.is_relative_to(tmp_path) and archive.path == file
    archive.close()


def test_the_folder_is_private_and_its_files_can_be_removed(fmu, tmp_path, private):
    """Mode 0700 outside, owner-writable inside whatever the archive says; close may be called twice."""
    entry = zipfile.ZipInfo("resources/readonly.txt")
    entry.external_attr = (stat.S_IFREG | 0o400) << 16
    archive = Unpacked(with_entries(fmu, tmp_path / "readonly.fmu", (entry, b"x")))
    (root,) = private.iterdir()
    assert stat.S_IMODE(root.stat().st_mode) == 0o700
    assert all(path.stat().st_mode & stat.S_IWUSR for path in root.rglob("*"))
    archive.close()
    archive.close()
    assert list(private.iterdir()) == []
    archive = Unpacked(fmu)
    del archive
    gc.collect()
    assert list(private.iterdir()) == []


def test_the_folder_goes_when_the_interpreter_ends_but_not_with_a_forked_child(fmu, tmp_path):
    """A child that inherits the object leaves the folder to its parent, which removes it."""
    code = f"""
import os, sys
from ctmhe.models.fmu.archive import Unpacked
archive = Unpacked({str(fmu)!r})
if hasattr(os, "fork"):
    child = os.fork()
    if child == 0:
        archive.close()
        os._exit(0)
    os.waitpid(child, 0)
assert (archive.folder / "modelDescription.xml").is_file()
"""
    subprocess.run([sys.executable, "-c", code], check=True, env={**os.environ, "TMPDIR": str(tmp_path)})
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_changes_while_it_is_read_does_not_matter(fmu, tmp_path, monkeypatch):
    """Hash and contents are of the one copy that was made."""
    file = rewritten(fmu, tmp_path / "moving.fmu")
    expected = hashlib.sha256(file.read_bytes()).hexdigest()
    real = archive_module._unpack

    def meddle(*arguments):
        file.write_bytes(b"something else")
        return real(*arguments)

    monkeypatch.setattr(archive_module, "_unpack", meddle)
    archive = Unpacked(file)
    assert archive.digest == expected
    assert read_description(archive.folder).name == "van_der_pol"
    archive.close()


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_whatever_the_bytes_only_fmu_errors_come_and_nothing_stays(fmu, private, data):
    """Flipped and cut bytes, and renamed entries, of a real FMU; the headers get half of the hits."""
    content = bytearray(fmu.read_bytes())
    directory = content.index(b"PK\x01\x02")
    spots = st.one_of(st.integers(0, len(content) - 1), st.integers(directory, len(content) - 1))
    for place, value in data.draw(st.lists(st.tuples(spots, st.integers(0, 255)), max_size=6)):
        content[place] = value
    if data.draw(st.booleans()):
        old = data.draw(st.sampled_from([b"sources/core.c", b"modelDescription.xml", b"binaries/linux64/"]))
        new = data.draw(st.binary(min_size=len(old), max_size=len(old)))
        content = content.replace(old, new)
    cut = data.draw(st.one_of(st.just(len(content)), st.integers(0, len(content))))
    file = private.parent.parent / "fuzzed.fmu"
    file.write_bytes(bytes(content[:cut]))
    try:
        open_and_read(file)
    except FmuError as error:
        assert type(error) is not FmuError
    assert [p.name for p in private.parent.rglob("*")] == ["private"]
