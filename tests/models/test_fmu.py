"""The FMU of a model is that model: values, derivatives, errors, and nothing left behind."""

import gc
import os
import pickle
import shutil
import stat
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import casadi as ca
import numpy as np
import pytest

pytest.importorskip("fmpy")

from ctmhe.errors import FmuError, FmuWarning, InputError, MissingExtra
from ctmhe.models.continuous import ContinuousModel, Model
from ctmhe.models.fmu import FmuModel
from ctmhe.models.fmu.archive import Unpacked
from ctmhe.models.fmu.description import CO_SIMULATION, MODEL_EXCHANGE
from ctmhe.models.fmu.instance import Instance
from ctmhe.models.fmu.reading import read_description
from fmus.build import build

X = np.array([2.3, 0.7])
U = np.array([0.05, -0.02])
W = np.array([0.01, 0.03, -0.2])
P = np.array([0.2, 0.01])
KEYS = "txuwp"


def python_reactor() -> ContinuousModel:
    def f(t, x, u, w, p):
        rate = p[0] * x[0] ** 2 - p[1] * x[1]
        return [-2 * rate + u[0] + w[0], rate + u[1] + w[1]]

    return ContinuousModel(
        f,
        lambda t, x, u, w, p: x[0] + x[1] + w[2],
        x=("pA", "pB"),
        u=("d_pA", "d_pB"),
        w=("w_pA", "w_pB", "v_pressure"),
        p=("k1", "k2"),
        y="pressure",
        p_start=(0.16, 0.0064),
    )


@pytest.fixture(scope="module", params=[2, 3], ids=["FMI2", "FMI3"])
def path(request):
    return build("batch_reactor", fmi=request.param)


@pytest.fixture(scope="module")
def model(path):
    return FmuModel(path, parameters=("k1", "k2"), output_noise=True)


def rewritten(source: Path, target: Path, change) -> Path:
    """Copy an FMU with its description changed."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for entry in old.infolist():
            data = old.read(entry)
            if entry.filename == "modelDescription.xml":
                text = data.decode()
                data = change(text).encode()
                assert data.decode() != text
            new.writestr(entry, data)
    return target


def jacobians(function: ca.Function, *arguments) -> list[np.ndarray]:
    values = function.jacobian().call([*arguments, *function.call(list(arguments))])
    return [np.array(ca.DM(value)) for value in values]


def chain(model: Model) -> ca.Function:
    """Four RK4 steps of 0.1 s, as an estimator makes them."""
    sizes = [1, len(model.x), len(model.u), len(model.w), len(model.p)]
    t, x, u, w, p = (ca.MX.sym(key, size) for key, size in zip(KEYS, sizes, strict=True))
    h, end = 0.1, x
    for _ in range(4):
        k1 = model.dynamics(t, end, u, w, p)
        k2 = model.dynamics(t + h / 2, end + h / 2 * k1, u, w, p)
        k3 = model.dynamics(t + h / 2, end + h / 2 * k2, u, w, p)
        k4 = model.dynamics(t + h, end + h * k3, u, w, p)
        end = end + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return ca.Function("chain", [t, x, u, w, p], [end, model.output(t + h, end, u, w, p)], list(KEYS), ["x1", "y1"])


@pytest.mark.parametrize("name", ["dynamics", "output"])
def test_fmu_equals_the_python_model(model, name):
    """Values and Jacobians in x, u, w and p agree to 1e-9."""
    ours, theirs = getattr(model, name), getattr(python_reactor(), name)
    assert isinstance(model, Model)
    np.testing.assert_allclose(ours(0.3, X, U, W, P), theirs(0.3, X, U, W, P), atol=1e-9)
    for mine, other in zip(jacobians(ours, 0.3, X, U, W, P), jacobians(theirs, 0.3, X, U, W, P), strict=True):
        np.testing.assert_allclose(mine, other, atol=1e-9)


def test_jacobian_of_a_mapped_chain_is_that_of_the_python_model_and_of_finite_differences(model):
    """CasADi's own FMU derivatives are wrong exactly here, and silently."""
    random, n = np.random.default_rng(4), 3
    columns = [
        np.zeros((1, n)),
        random.uniform(0.5, 3.0, (2, n)),
        random.normal(0.0, 0.1, (2, n)),
        random.normal(0.0, 0.1, (3, n)),
        P[:, None] * random.uniform(0.5, 1.5, (2, n)),
    ]

    def derivatives(model: Model):
        mapped = chain(model).map(n)
        symbols = [ca.MX.sym(key, *column.shape) for key, column in zip(KEYS, columns, strict=True)]
        ends = ca.veccat(*mapped(*symbols))
        value = ca.Function("value", symbols, [ends])
        return value, ca.Function("J", symbols, [ca.jacobian(ends, ca.vec(symbol)) for symbol in symbols[1:]])

    value, jacobian = derivatives(model)
    ours = [np.array(ca.DM(block)) for block in jacobian(*columns)]
    theirs = [np.array(ca.DM(block)) for block in derivatives(python_reactor())[1](*columns)]
    for mine, other in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(mine, other, atol=1e-9)
    step = 1e-5  # central differences of values of order 1: an error near 1e-10
    for i, block in enumerate(ours, start=1):
        for j in range(columns[i].size):
            sides = []
            for sign in (1.0, -1.0):
                moved = [column.copy() for column in columns]
                moved[i].reshape(-1, order="F")[:] = columns[i].reshape(-1, order="F")
                flat = moved[i].flatten(order="F")
                flat[j] += sign * step
                moved[i] = flat.reshape(columns[i].shape, order="F")
                sides.append(np.array(value(*moved)).reshape(-1))
            np.testing.assert_allclose(block[:, j], (sides[0] - sides[1]) / (2 * step), atol=1e-8)


def test_second_derivatives_agree_with_the_python_model(model):
    """A solver that wants the exact Hessian gets one, by differences of the Jacobian (1e-6)."""
    hessians = []
    for each in (model, python_reactor()):
        x, p = ca.MX.sym("x", 2), ca.MX.sym("p", 2)
        cost = ca.dot(ca.DM([1.0, 3.0]), each.dynamics(0, x, U, W, p))
        hessian = ca.hessian(cost, ca.vertcat(x, p))[0]
        hessians.append(np.array(ca.DM(ca.Function("H", [x, p], [hessian])(X, P))))
    np.testing.assert_allclose(*hessians, atol=1e-6)


def test_signals_carry_the_names_and_units_of_the_fmu(model):
    """The FMU's own words, in the order asked for."""
    assert (model.x.names, model.u.names, model.p.names) == (("pA", "pB"), ("d_pA", "d_pB"), ("k1", "k2"))
    assert model.w.names == ("w_pA", "w_pB", "v_pressure")
    assert model.w.units == ("bar/s", "bar/s", "bar")
    assert model.step is None and "pressure [bar]" in repr(model)
    np.testing.assert_array_equal(model.x_start, [3.0, 1.0])
    np.testing.assert_array_equal(model.u_start, [0.0, 0.0])
    np.testing.assert_array_equal(model.p_start, [0.16, 0.0064])


def test_order_and_selection_follow_the_caller(path):
    """Reordered parameters, one input, one disturbance, a state measured, and start values given."""
    start = {"k1": 0.2, "d_pA": 0.3, "pB": 0.5}
    own = FmuModel(
        path, inputs=["d_pB"], outputs=["pB", "pressure"], parameters=["k2"], disturbances=["pB"], start=start
    )
    rate = 0.2 * X[0] ** 2 - 0.01 * X[1]
    value = own.dynamics(0.0, X, [0.1], [0.02], [0.01])
    np.testing.assert_allclose(np.array(value).ravel(), [-2 * rate + 0.3, rate + 0.12], rtol=1e-12)
    np.testing.assert_allclose(np.array(own.output(0.0, X, [0], [0], [0.01])).ravel(), [X[1], X.sum()])
    np.testing.assert_array_equal(own.x_start, [3.0, 0.5])
    slope = jacobians(own.output, 0.0, X, [0.1], [0.02], [0.01])[1]
    np.testing.assert_array_equal(slope, [[0, 1], [1, 1]])
    reordered = FmuModel(path, parameters=["k2", "k1"], inputs=["d_pB", "d_pA"])
    expected = python_reactor().dynamics(0, X, U, [0, 0, 0], P)
    np.testing.assert_allclose(reordered.dynamics(0, X, U[::-1], [0, 0], P[::-1]), expected)
    np.testing.assert_allclose(jacobians(reordered.dynamics, 0, X, U, [0, 0], P[::-1])[2], [[0, 1], [1, 0]])


def test_model_pickles_as_its_configuration(path, tmp_path):
    """A copy from a pickle is the same model; of a file that has changed it is refused."""
    file = Path(shutil.copy(path, tmp_path / "plant.fmu"))
    model = FmuModel(file, parameters=["k1"], start={"k2": 0.01})
    saved = pickle.dumps(model)
    copy = pickle.loads(saved)
    np.testing.assert_array_equal(copy.dynamics(0, X, U, [0, 0], [0.2]), model.dynamics(0, X, U, [0, 0], [0.2]))
    rewritten(path, file, lambda text: text.replace('start="0.0064"', 'start="0.0065"'))
    with pytest.raises(FmuError, match="has changed"):
        pickle.loads(saved)


def test_without_directional_derivatives_jacobians_are_central_differences(path, tmp_path):
    """An FMU that offers none is differentiated to 1e-8, also inside a mapped chain."""
    silent = rewritten(
        path,
        tmp_path / "silent.fmu",
        lambda text: text.replace('providesDirectionalDerivatives="true"', "").replace(
            'providesDirectionalDerivative="true"', ""
        ),
    )
    model = FmuModel(silent, parameters=("k1", "k2"), output_noise=True)
    assert not model.exact_derivatives
    for ours, theirs in ((model.dynamics, python_reactor().dynamics), (chain(model), chain(python_reactor()))):
        for mine, other in zip(jacobians(ours, 0, X, U, W, P), jacobians(theirs, 0, X, U, W, P), strict=True):
            np.testing.assert_allclose(mine, other, atol=1e-8)


def test_wrong_dependencies_are_found_and_named(path, tmp_path):
    """What `dependencies` leave out is named in a warning; Jacobians are right all the same."""
    fmi3 = 'fmiVersion="3' in zipfile.ZipFile(path).read("modelDescription.xml").decode()

    def without(name: str):
        reference = reference_of(path, name, fmi3)

        def change(text: str) -> str:
            root = ElementTree.fromstring(text)
            kind = "ModelStructure/ContinuousStateDerivative" if fmi3 else "ModelStructure/Derivatives/Unknown"
            for unknown in root.findall(kind):
                kept = [d for d in unknown.get("dependencies", "").split() if d != reference]
                unknown.set("dependencies", " ".join(kept))
                unknown.attrib.pop("dependenciesKind", None)
            return ElementTree.tostring(root, encoding="unicode")

        return rewritten(path, tmp_path / f"without_{name}.fmu", change)

    right = FmuModel(path, parameters=["k1"])
    named = {"pA": "pA"} | ({"k1": "k1"} if fmi3 else {})  # FMI 2 does not list parameters among the dependencies
    for name in named:
        with pytest.warns(FmuWarning, match=rf"der\(pA\) on {name}"):
            model = FmuModel(without(name), parameters=["k1"])
        for mine, other in zip(
            jacobians(model.dynamics, 0, X, U, W[:2], P[:1]),
            jacobians(right.dynamics, 0, X, U, W[:2], P[:1]),
            strict=True,
        ):
            np.testing.assert_array_equal(mine, other)


def reference_of(path: Path, name: str, fmi3: bool) -> str:
    """Return how `dependencies` refers to a variable: by value reference in FMI 3, by position in FMI 2."""
    variables = ElementTree.fromstring(zipfile.ZipFile(path).read("modelDescription.xml")).find("ModelVariables")
    assert variables is not None
    for position, variable in enumerate(variables, start=1):
        if variable.get("name") == name:
            return variable.attrib["valueReference"] if fmi3 else str(position)
    raise AssertionError(name)


@pytest.mark.parametrize(
    ("arguments", "near"),
    [
        ({"inputs": ["dpA"]}, "d_pA"),
        ({"outputs": ["presure"]}, "pressure"),
        ({"parameters": ["k_1"]}, "k1"),
        ({"disturbances": ["pAA"]}, "pA"),
        ({"start": {"k11": 1.0}}, "k1"),
    ],
)
def test_unknown_names_suggest_the_nearest(path, arguments, near):
    """Every way to name a variable helps after a slip."""
    with pytest.raises(InputError, match=f"did you mean '{near}'"):
        FmuModel(path, **arguments)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: _without_element(text, "ModelExchange"), "say step="),
        (lambda text: text.replace('fmiVersion="2.0"', 'fmiVersion="1.0"').replace('"3.0"', '"4.0"'), "FMI version"),
        (lambda text: text[:200], "cannot be parsed"),
        (
            lambda text: text.replace('modelIdentifier="', 'modelIdentifier="other_'),
            "has no binaries/.*other_batch_reactor",
        ),
        (
            lambda text: text.replace('guid="{', 'guid="{0').replace('Token="{', 'Token="{0'),
            "instantiation gave 'error'.*does not belong",
        ),
    ],
    ids=["co-simulation only", "version", "broken", "no binary", "wrong identity"],
)
def test_unsuitable_fmus_are_refused_with_the_reason(path, tmp_path, change, message):
    """Each with an FmuError, and nothing left in the temporary folder."""
    with pytest.raises(FmuError, match=message):
        FmuModel(rewritten(path, tmp_path / "bad.fmu", change))


def _without_element(text: str, name: str) -> str:
    root = ElementTree.fromstring(text)
    for element in root.findall(name):
        root.remove(element)
    return ElementTree.tostring(root, encoding="unicode")


@pytest.mark.parametrize("name", ["../evil.txt", "a/../../evil.txt", "/evil.txt", "C:/evil.txt", "a\\evil.txt", "link"])
def test_entries_that_would_leave_the_folder_are_refused(tmp_path, monkeypatch, name):
    """The entry is named; nothing is written anywhere."""
    private = tmp_path / "private"
    private.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(private))
    file = tmp_path / "evil.fmu"
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("modelDescription.xml", "<fmiModelDescription/>")
        entry = zipfile.ZipInfo(name)
        if name == "link":
            entry.external_attr = (stat.S_IFLNK | 0o777) << 16
        archive.writestr(entry, "/etc/passwd")
    with pytest.raises(FmuError, match="refused") as error:
        FmuModel(file)
    assert repr(name) in str(error.value)
    assert list(private.iterdir()) == []
    assert sorted(p.name for p in tmp_path.iterdir()) == ["evil.fmu", "private"]


def test_what_is_no_fmu_is_refused(tmp_path):
    """A missing file, a text file, a damaged archive and an archive without a description."""
    with pytest.raises(FmuError, match="no such FMU file"):
        FmuModel(tmp_path / "nowhere.fmu")
    text = tmp_path / "text.fmu"
    text.write_text("not a zip")
    with pytest.raises(FmuError, match="zip archive"):
        FmuModel(text)
    with zipfile.ZipFile(tmp_path / "empty.fmu", "w") as archive:
        archive.writestr("readme.txt", "hello" * 100)
    with pytest.raises(FmuError, match=r"no modelDescription\.xml"):
        FmuModel(tmp_path / "empty.fmu")
    data = bytearray((tmp_path / "empty.fmu").read_bytes())
    data[60] ^= 0xFF  # inside the stored text: its checksum no longer fits
    (tmp_path / "damaged.fmu").write_bytes(data)
    with pytest.raises(FmuError, match="zip archive"):
        FmuModel(tmp_path / "damaged.fmu")


def test_no_temporary_folder_is_left(path, tmp_path, monkeypatch):
    """Gone after close, after garbage collection, and after a failure; the working directory is untouched."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    here, files = Path.cwd(), sorted(os.listdir())
    model = FmuModel(path)
    assert len(list(tmp_path.iterdir())) == 1
    model.close()
    assert list(tmp_path.iterdir()) == []
    model = FmuModel(path)
    del model
    gc.collect()
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(InputError):
        FmuModel(path, inputs=["nothing"])
    assert list(tmp_path.iterdir()) == []
    assert (Path.cwd(), sorted(os.listdir())) == (here, files)


def test_without_fmpy_the_message_names_the_extra(path, monkeypatch):
    """What to install, not an import error of something else."""
    for name in [name for name in sys.modules if name.split(".")[0] == "fmpy"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "fmpy", None)
    with pytest.raises(MissingExtra, match=r"ctmhe\[fmu\]"):
        FmuModel(path)


def test_importing_the_model_does_not_import_fmpy():
    """The optional library is loaded when an FMU is read, not before."""
    code = "import sys, ctmhe.models.fmu, ctmhe.simulation.fmu.plant; assert 'fmpy' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("kind", [MODEL_EXCHANGE, CO_SIMULATION])
def test_instances_differentiate_and_come_back(path, kind):
    """Directional derivatives are the Jacobian times the seed; a saved state brings everything back."""
    archive = Unpacked(path)
    about = read_description(archive.folder)
    instance = Instance(about, archive.folder, kind)
    instance.initialize(0.0, {"pA": X[0], "pB": X[1], "k1": P[0], "k2": P[1]})
    slope = np.array([[-4 * P[0] * X[0], 2 * P[1]], [2 * P[0] * X[0], -P[1]]])
    seed = np.array([1.0, -2.0])
    np.testing.assert_allclose(instance.directional(about.derivatives, about.states, seed), slope @ seed, rtol=1e-12)
    saved = instance.save()
    instance.set(about.inputs, [1.0, 2.0])
    instance.load(saved)
    np.testing.assert_array_equal(instance.get(about.inputs), [0.0, 0.0])
    with pytest.raises(FmuError, match="pressure"):
        instance.set(about.outputs, [1.0])
    instance.close()
    with pytest.raises(FmuError, match="closed"):
        instance.get(about.states)
    archive.close()
