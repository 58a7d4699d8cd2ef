"""The repository's own rules, over every tracked file."""

from __future__ import annotations

import ast
import importlib
import inspect
import os
import re
import subprocess
import sys
import tomllib
import types
from collections.abc import Callable
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
HEAVY = {"hydra", "lightning", "pytorch_lightning", "omegaconf", "open3d"}
# Which rooms a room may import. Whoever wants another arrow has put something in the wrong room.
LOW = {"capture", "places"}
CORE_ROOMS = LOW | {"functional", "model", "effects"}
MAY_IMPORT = {
    "places": set(),
    "capture": set(),
    "functional": LOW,
    "io": LOW,
    "runtime": LOW,
    "metrics": LOW | {"io"},
    "model": LOW | {"functional"},
    "effects": LOW | {"functional"},
    "baselines": LOW | {"functional", "io", "model"},
    "surfels": CORE_ROOMS | {"io", "metrics", "runtime", "data_modules"},
    "inference": CORE_ROOMS | {"surfels", "metrics", "io", "runtime"},
    "report": LOW | {"effects", "inference", "io"},
    "training": CORE_ROOMS | {"surfels", "inference", "report", "metrics", "io", "runtime", "data_modules"},
    "paper": CORE_ROOMS
    | {"surfels", "report", "training", "baselines", "metrics", "io", "runtime", "data_modules"},
    "data_modules": LOW,
}
MAY_IMPORT["api"] = set(MAY_IMPORT) - {"paper"}
MAY_IMPORT["commands"] = set(MAY_IMPORT)
MAY_IMPORT["__main__"] = {"commands"}
PINNED_EXTRAS = ("dev", "sweep", "optuna", "notebooks")
DOORS = ("train", "diagnose", "reconstruct", "simulate", "results", "inspect_capture", "compare", "view")


def _tracked() -> list[str]:
    listed = subprocess.run(
        ["git", "-C", str(ROOT), "ls-files", "-z"], capture_output=True, text=True, check=False
    )
    if listed.returncode:
        pytest.skip("not a git checkout: these rules are about tracked files", allow_module_level=True)
    return [name for name in listed.stdout.split("\0") if name and (ROOT / name).exists()]


TRACKED = _tracked()
MODULES = [name for name in TRACKED if name.endswith(".py")]
PRODUCT = [name for name in MODULES if not name.startswith("tests/")]
CORE = [
    name for name in PRODUCT if {"functional", "model", "effects", "baselines"} & set(Path(name).parts[:-1])
]


def syntax(name: str) -> ast.Module:
    return ast.parse((ROOT / name).read_text(encoding="utf-8"), name)


def imported(tree: ast.AST) -> set[str]:
    """Top-level names of all packages imported anywhere in a module."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            found.add(node.module.split(".")[0])
    return found


def room_of(module: str) -> str:
    """``nlos_lit.capture.scan`` → ``capture``, ``data_modules.load`` → ``data_modules``, ``train`` itself."""
    parts = module.split(".")
    return parts[1] if parts[0] == "nlos_lit" and len(parts) > 1 else parts[0]


def imported_rooms(name: str) -> set[str]:
    """Rooms of the project, data_modules and commands that a module imports anywhere."""
    found = set()
    for node in ast.walk(syntax(name)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    ours = {module for module in found if module.split(".")[0] in {"nlos_lit", "data_modules", *DOORS}}
    return {room_of(module) for module in ours}


@pytest.mark.parametrize("name", [n for n in PRODUCT if n.startswith(("nlos_lit/", "data_modules/"))])
def test_imports_go_one_way(name):
    room = room_of(dotted(name))
    if room == "nlos_lit":  # the package's own __init__
        return
    assert imported_rooms(name) - {room, "nlos_lit"} <= MAY_IMPORT[room]


def test_doors_open_commands_alone():
    """They hold no logic: they open the command of their name."""
    for door in DOORS:
        assert imported_rooms(f"{door}.py") == {"commands"}, door


@pytest.mark.parametrize("name", CORE)
def test_the_core_names_no_framework(name):
    assert not imported(syntax(name)) & HEAVY


def loaded_by(modules: list[str]) -> set[str]:
    code = f"""import importlib, sys
for name in {modules!r}:
    importlib.import_module(name)
print(*{{name.split(".")[0] for name in sys.modules}})"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return set(done.stdout.split())


def dotted(name: str) -> str:
    return name.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def test_a_machine_with_only_torch_can_import_the_core():
    assert not loaded_by([dotted(name) for name in CORE]) & HEAVY


def test_importing_the_package_loads_no_framework():
    assert not loaded_by(["nlos_lit", "data_modules"]) & HEAVY


def test_no_module_imports_open3d_when_it_is_imported():
    """Inside functions only, so that everything but meshes and ray casting works without its system
    libraries.
    """
    offenders = []
    for name in MODULES:
        body = [
            node
            for node in syntax(name).body
            if not (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test))
        ]
        top = [node for node in body if not isinstance(node, (ast.FunctionDef, ast.ClassDef))]
        if "open3d" in set().union(*map(imported, top), set()):
            offenders.append(name)
    assert offenders == []


PLACES = re.compile(r"(?<![\w./~$}-])/(?:work|root|home)(?:/|\b)")
HOSTS = re.compile(
    "|".join(
        name.replace("_", r"\.")
        for name in ("pypi_org", "pythonhosted_org", "download_pytorch_org", "anaconda_org")
    )
)


def test_no_file_names_this_machine_or_a_package_host():
    offenders = []
    for name in TRACKED:
        content = (ROOT / name).read_bytes()
        if b"\0" in content:
            continue
        for number, line in enumerate(content.decode("utf-8").splitlines(), 1):
            if PLACES.search(line) or HOSTS.search(line):
                offenders.append(f"{name}:{number}: {line.strip()[:100]}")
    assert offenders == []


def test_the_patterns_find_what_they_are_for():
    assert PLACES.search('open("/ro' + 'ot/x")')
    assert PLACES.search("path: /wo" + "rk")
    assert not PLACES.search("tests/work and nlos/home/x and https://example.com/home")
    assert HOSTS.search("https://py" + "pi.org/simple")


UNSAFE_MODULES = {"pickle", "_pickle", "cPickle", "cloudpickle", "dill", "marshal", "shelve", "jsonpickle"}
UNSAFE_CALLS = {"yaml.unsafe_load", "yaml.full_load", "joblib.load", "eval", "exec"}


def unsafe_calls(tree: ast.AST) -> list[str]:
    """Calls, imports and base classes through which a file could run code."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            unsafe = bool({alias.name.split(".")[0] for alias in node.names} & UNSAFE_MODULES)
        elif isinstance(node, ast.ImportFrom):
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            unsafe = str(node.module).split(".")[0] in UNSAFE_MODULES or bool(names & UNSAFE_CALLS)
        elif isinstance(node, ast.ClassDef):
            unsafe = any(ast.unparse(base).endswith("Unpickler") for base in node.bases)
        else:
            unsafe = isinstance(node, ast.Call) and unsafe_call(node)
        if unsafe:
            found.append(f"line {node.lineno}: {ast.unparse(node)}")
    return found


def unsafe_call(node: ast.Call) -> bool:
    called = ast.unparse(node.func)
    arguments = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
    loader = arguments.get("Loader", ast.unparse(node.args[1]) if len(node.args) > 1 else "")
    return (
        (called == "torch.load" and arguments.get("weights_only") != "True")
        or (called == "yaml.load" and "Safe" not in loader)
        or called in UNSAFE_CALLS
        or called.split(".")[0] in UNSAFE_MODULES
        or called.split(".")[-1] in ("Unpickler", "read_pickle")
        or arguments.get("allow_pickle", "False") != "False"
    )


@pytest.mark.parametrize("name", PRODUCT)
def test_no_file_that_is_read_can_run_code(name):
    assert unsafe_calls(syntax(name)) == []


@pytest.mark.parametrize(
    ("code", "safe"),
    [
        ("torch.load(f)", False),
        ("torch.load(f, weights_only=True)", True),
        ("yaml.load(f)", False),
        ("yaml.load(f, yaml.Loader)", False),
        ("yaml.load(f, Loader=yaml.CSafeLoader)", True),
        ("yaml.safe_load(f)", True),
        ("np.load(f, allow_pickle=True)", False),
        ("np.load(f, allow_pickle=trusted)", False),
        ("np.load(f, allow_pickle=False)", True),
        ("import pickle", False),
        ("import pickle as p", False),
        ("from pickle import Unpickler", False),
        ("from _pickle import loads", False),
        ("class Reader(pickle.Unpickler): pass", False),
        ("class Reader(Unpickler): pass", False),
        ("pickle.Unpickler(f).load()", False),
        ("pickle.loads(f)", False),
        ("Unpickler(f).load()", False),
        ("import marshal", False),
        ("shelve.open(f)", False),
        ("joblib.load(f)", False),
        ("from joblib import load", False),
        ("joblib.dump(x, f)", True),
        ("from dill import load", False),
        ("pd.read_pickle(f)", False),
        ("import json", True),
        ("from json import load", True),
        ("from . import steps", True),
        ("model.eval()", True),
    ],
)
def test_unsafe_calls_are_recognised(code, safe):
    assert (unsafe_calls(ast.parse(code)) == []) == safe


def test_every_declared_dependency_is_pinned():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lines = [
        line
        for line in (ROOT / "constraints.txt").read_text().splitlines()
        if line and not line.startswith("#")
    ]
    pins = [Requirement(line) for line in lines]
    assert all(re.fullmatch(r"==[^*]+", str(pin.specifier)) for pin in pins)
    versions = {canonicalize_name(pin.name): str(pin.specifier)[2:] for pin in pins}
    assert len(versions) == len(pins)
    extras = [text for name in PINNED_EXTRAS for text in project["optional-dependencies"][name]]
    for text in project["dependencies"] + extras:
        wanted = Requirement(text)
        assert versions[canonicalize_name(wanted.name)] in wanted.specifier, text


@pytest.mark.parametrize("name", [".ci/run", "scripts/setup.sh"])
def test_scripts_run(name):
    assert os.access(ROOT / name, os.X_OK)
    assert subprocess.run(["bash", "-n", str(ROOT / name)], check=False).returncode == 0


def test_ci_runs_the_tests_the_readme_names():
    assert "make test" in (ROOT / ".ci/run").read_text()
    dry = subprocess.run(
        ["make", "-n", "-C", str(ROOT), "test", "VENV=nowhere"], capture_output=True, text=True, check=True
    ).stdout
    assert "scripts/setup.sh" in dry
    assert dry.index("scripts/setup.sh") < dry.index("nowhere/bin/python -m pytest")


def undocumented(module: types.ModuleType) -> list[str]:
    """Public functions of two or more arguments whose docstring lacks what one looks up: arguments, result.

    What a method overrides is described where it first stands.
    """
    found = []
    for name, member in vars(module).items():
        if name.startswith("_") or getattr(member, "__module__", None) != module.__name__:
            continue
        if inspect.isclass(member):
            inherited = {attribute for base in member.__mro__[1:] for attribute in vars(base)}
            own = {f"{name}.{n}": f for n, f in vars(member).items() if n not in inherited and n[0] != "_"}
        else:
            own = {name: member}
        for title, function in own.items():
            function = inspect.unwrap(getattr(function, "__func__", function))
            if inspect.isfunction(function) and not described(function):
                found.append(title)
    return found


def described(function: Callable[..., object]) -> bool:
    signature = inspect.signature(function)
    arguments = set(signature.parameters) - {"self", "cls"}
    text = function.__doc__ or ""
    silent = signature.return_annotation in (None, "None")
    return len(arguments) < 2 or ("Args:" in text and (silent or bool(re.search("Returns:|Yields:", text))))


@pytest.mark.parametrize("name", [n for n in PRODUCT if n.startswith(("nlos_lit/", "data_modules/"))])
def test_functions_say_what_they_take_and_give(name):
    assert undocumented(importlib.import_module(dotted(name))) == []


def test_undocumented_functions_are_found():
    module = types.ModuleType("example")
    module.f = lambda a, b: None
    module.f.__module__ = "example"
    assert undocumented(module) == ["f"]
    module.f.__doc__ = "Args:\n    a, b: numbers"
    assert undocumented(module) == ["f"]
    module.f.__doc__ += "\nReturns:\n    nothing"
    assert undocumented(module) == []
