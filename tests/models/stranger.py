"""An FMU that shares nothing with the framework in `fmus/`: `stranger.c`, with a description as tools write them."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from importlib.util import find_spec
from pathlib import Path

from ctmhe.compilers import find_compiler

SOURCE = Path(__file__).with_suffix(".c")
DESCRIPTION = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="Pendel ä [1].'q r'" guid="{{stranger}}" numberOfEventIndicators="0">
  <ModelExchange modelIdentifier="stranger" providesDirectionalDerivative="{directional}"/>
  <LogCategories><Category name="logEvents"/><Category name="logStatusError"/></LogCategories>
  <ModelVariables>
    <ScalarVariable name="kind" valueReference="900" causality="parameter" variability="fixed"><Integer start="3"/></ScalarVariable>
    <ScalarVariable name="label" valueReference="17" causality="parameter" variability="fixed"><String start="a &quot;b&quot;"/></ScalarVariable>
    <ScalarVariable name="pos 'ä'[1]" valueReference="900" initial="exact"><Real start="1"/></ScalarVariable>
    <ScalarVariable name="y" valueReference="900" causality="output" initial="exact"><Real start="1"/></ScalarVariable>
    <ScalarVariable name="v" valueReference="17" {v_initial}</ScalarVariable>
    <ScalarVariable name="der(pos 'ä'[1])" valueReference="17"><Real derivative="3"/></ScalarVariable>
    <ScalarVariable name="der(v)" valueReference="3" causality="output"><Real derivative="5"/></ScalarVariable>
    <ScalarVariable name="force" valueReference="42" causality="input"><Real start="0"/></ScalarVariable>
    <ScalarVariable name="sampled" valueReference="43" causality="input" variability="discrete"><Real start="0"/></ScalarVariable>
    <ScalarVariable name="k" valueReference="5" causality="parameter" variability="tunable"><Real start="2"/></ScalarVariable>
    <ScalarVariable name="c" valueReference="6" causality="parameter" variability="tunable"><Real start="0.3"/></ScalarVariable>
    <ScalarVariable name="energy" valueReference="8"><Real/></ScalarVariable>
  </ModelVariables>
  <ModelStructure>
    <Outputs><Unknown index="4" dependencies="3"/><Unknown index="7" dependencies="4 5 8 9"/></Outputs>
    <Derivatives><Unknown index="6" dependencies="5"/><Unknown index="7" dependencies="4 5 8 9"/></Derivatives>
  </ModelStructure>
</fmiModelDescription>
"""  # noqa: E501  one variable a line


def stranger(folder: Path, *macros: str, directional: bool = True) -> Path:
    """Return the FMU, compiled with these macros, in a folder with a blank in its name."""
    compiler = find_compiler()
    assert compiler is not None
    spec = find_spec("fmpy")
    assert spec is not None and spec.origin is not None
    headers = Path(spec.origin).parent / "c-code"
    library, path = folder / "stranger.so", folder / "a stranger.fmu"
    flags = ["-shared", "-fPIC", "-O1", "-w", f"-I{headers}", *(f"-D{macro}" for macro in macros)]
    subprocess.run([*compiler.command, *flags, str(SOURCE), "-o", str(library), "-lm"], check=True)
    equation = "INITIAL_EQUATION" in macros
    description = DESCRIPTION.format(
        directional=str(directional).lower(),
        v_initial='initial="calculated"><Real/>' if equation else 'initial="approx"><Real start="0"/>',
    )
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", description)
        archive.write(library, "binaries/linux64/stranger.so")
    return path


PORTABLE = sys.platform == "linux" and find_compiler() is not None
"""Whether it can be made here."""
