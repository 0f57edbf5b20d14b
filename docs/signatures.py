"""For mkdocstrings: the constructor of an `eqx.Module` or `NamedTuple`, which follows from its fields, as the signature of its class."""

import griffe

POSITIONAL, KEYWORD = griffe.ParameterKind.positional_or_keyword, griffe.ParameterKind.keyword_only


def fields_of(cls: griffe.Class) -> dict[str, griffe.Parameter]:
    """Annotated class attributes in the order of a dataclass, the parents' first; abstract and class variables left out."""
    found: dict[str, griffe.Parameter] = {}
    for base in [*reversed(cls.mro()), cls]:
        for name, member in base.members.items():
            if not member.is_attribute or member.is_alias or member.annotation is None or "property" in member.labels:
                continue
            if "ClassVar" in str(member.annotation) or "AbstractVar" in str(member.annotation):
                continue
            found[name] = parameter(name, member)
    return found


def parameter(name: str, field: griffe.Attribute) -> griffe.Parameter:
    """A field as a parameter; `eqx.field(default=..., default_factory=..., kw_only=...)` is understood."""
    default, kind = field.value, POSITIONAL
    if isinstance(default, griffe.ExprCall) and str(default.function) in ("eqx.field", "field"):
        given = {a.name: a.value for a in default.arguments if isinstance(a, griffe.ExprKeyword)}
        kind = KEYWORD if str(given.get("kw_only")) == "True" else POSITIONAL
        default = given.get("default", "..." if "default_factory" in given else None)
    return griffe.Parameter(name, annotation=field.annotation, kind=kind, default=default)


class Signatures(griffe.Extension):
    def on_package(self, *, pkg: griffe.Module, **kwargs: object) -> None:
        for module in pkg.modules.values():
            for cls in module.classes.values():
                if not cls.is_alias and "__init__" not in cls.all_members and is_data(cls):
                    own = fields_of(cls)
                    ordered = sorted(own.values(), key=lambda p: p.kind is KEYWORD)
                    cls.set_member("__init__", made(cls, ordered))


def is_data(cls: griffe.Class) -> bool:
    bases = [str(base) for parent in [cls, *cls.mro()] for base in parent.bases]
    return any(base.endswith(("Module", "NamedTuple")) for base in bases)


def made(cls: griffe.Class, parameters: list[griffe.Parameter]) -> griffe.Function:
    this = griffe.Parameter("self", kind=POSITIONAL)
    return griffe.Function("__init__", parameters=griffe.Parameters(this, *parameters), parent=cls)
