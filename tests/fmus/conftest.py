"""Unpacked FMUs and instances that are freed at the end of a test."""

from __future__ import annotations

import pytest


@pytest.fixture(scope="session")
def unzipped(tmp_path_factory):
    pytest.importorskip("fmpy")
    from tests.fmus.instances import unzip

    folders = {}

    def folder(name, fmi):
        if (name, fmi) not in folders:
            folders[name, fmi] = unzip(name, fmi, tmp_path_factory.mktemp(f"{name}{fmi}"))
        return folders[name, fmi]

    return folder


@pytest.fixture
def opened(unzipped):
    from tests.fmus.instances import Opened

    instances = []

    def make(name, fmi, kind=None, **options):
        instances.append(Opened(unzipped(name, fmi), name, fmi, kind, **options))
        return instances[-1]

    yield make
    for instance in instances:
        instance.close()
