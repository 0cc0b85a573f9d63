"""The extras: what campaigns, pictures and keys need, and a robot does not."""

from importlib.util import find_spec

from compose.status import UserError


def need(*modules: str, extra: str = "lab") -> None:
    """See to it that these are installed. Raises UserError."""
    missing = [module for module in modules if find_spec(module) is None]
    if missing:
        raise UserError(f"needs {', '.join(missing)}: install `tandem-ranging[{extra}]`")
