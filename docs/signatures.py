"""For mkdocstrings: signatures of classes whose constructor follows from their fields, and the
values of named defaults."""

import ast
import re
from pathlib import Path

import griffe

POSITIONAL, KEYWORD = griffe.ParameterKind.positional_or_keyword, griffe.ParameterKind.keyword_only
TABLE = ast.parse(
    (Path(__file__).parents[1] / "src/jaxmuscle/model/_parameters.py").read_text(encoding="utf-8")
)
ROWS = [
    n.args
    for n in ast.walk(TABLE)
    if isinstance(n, ast.Call) and ast.unparse(n.func) in ("Parameter", "_free_sign")
]
DEFAULTS = {
    ast.unparse(row[0]).strip("'"): ast.unparse(row[3])
    for row in ROWS
    if isinstance(row[3], ast.Constant)
}


class Signatures(griffe.Extension):
    """`eqx.Module` and `NamedTuple` make constructors at run time, which griffe, reading the
    sources, does not see."""

    def on_package(self, *, pkg: griffe.Module, **kwargs: object) -> None:
        for module in [
            part for wing in pkg.modules.values() for part in (wing, *wing.modules.values())
        ]:
            classes = [cls for cls in module.classes.values() if not cls.is_alias]
            for cls in filter(makes_constructor, classes):
                cls.set_member("__init__", constructor(cls))
            # what prints and saves results is nothing that a reader could look up
            for cls in classes:
                cls.bases = [
                    b for b in cls.bases if str(b) not in ("Shown", "Printed", "Spelled", "Result")
                ]
            functions = [
                f
                for place in (module, *classes)
                for f in place.functions.values()
                if not f.is_alias
            ]
            for parameter in (p for function in functions for p in function.parameters):
                parameter.default = constant(parameter.default, module)


def makes_constructor(cls: griffe.Class) -> bool:
    family = [cls, *cls.mro()]
    bases = [str(base) for parent in family for base in parent.bases]
    written = any(
        "__init__" in parent.members for parent in family if not parent.name.startswith("Abstract")
    )
    return (
        not written
        and not cls.name.startswith("Abstract")
        and any(b.endswith(("Module", "NamedTuple")) for b in bases)
    )


def constructor(cls: griffe.Class) -> griffe.Function:
    this = griffe.Parameter("self", kind=POSITIONAL)
    given = sorted(fields_of(cls).values(), key=lambda p: p.kind is KEYWORD)
    return griffe.Function("__init__", parameters=griffe.Parameters(this, *given), parent=cls)


def fields_of(cls: griffe.Class) -> dict[str, griffe.Parameter]:
    """Annotated class attributes in the order of a dataclass, the parents' first; abstract and
    class variables left out."""
    found: dict[str, griffe.Parameter] = {}
    for parent in [*reversed(cls.mro()), cls]:
        for name, member in parent.members.items():
            if (
                member.is_alias
                or not member.is_attribute
                or "instance-attribute" not in member.labels
            ):
                continue
            if member.annotation is not None and "AbstractVar" not in str(member.annotation):
                found[name] = parameter(name, member)
    return found


def parameter(name: str, field: griffe.Attribute) -> griffe.Parameter:
    """A field as a parameter; `eqx.field(default=..., default_factory=..., kw_only=...)` is
    understood."""
    default, kind = field.value, POSITIONAL
    if isinstance(default, griffe.ExprCall) and str(default.function) in ("eqx.field", "field"):
        given = {a.name: a.value for a in default.arguments if isinstance(a, griffe.ExprKeyword)}
        kind = KEYWORD if str(given.get("kw_only")) == "True" else POSITIONAL
        default = given.get("default", "..." if "default_factory" in given else None)
    return griffe.Parameter(
        name, annotation=field.annotation, kind=kind, default=tabulated(default)
    )


def tabulated(default: object) -> object:
    """`default("k_w")` and `PARAMETERS["k_w"].default` as the number in the parameter table."""
    found = re.fullmatch(
        r"""(?:default\(|PARAMETERS\[)['"](\w+)['"][)\]](?:\.default)?""", str(default)
    )
    return DEFAULTS[found[1]] if found else default


def constant(default: object, module: griffe.Module) -> object:
    """A default that names a constant as the constant's value, if that is a literal."""
    default = tabulated(default)
    if not isinstance(default, griffe.ExprName):
        return default
    try:
        value = module[default.name]
        value = value.final_target if value.is_alias else value
        ast.literal_eval(str(value.value))
    except (KeyError, ValueError, SyntaxError, AttributeError, griffe.AliasResolutionError):
        return default
    return value.value
