"""Run-time check of array shapes and argument types at the public entry points, by their annotations."""

from beartype import BeartypeConf, beartype
from jaxtyping import jaxtyped

# An int is accepted for a float (PEP 484).
_check = beartype(conf=BeartypeConf(is_pep484_tower=True))

checked = jaxtyped(typechecker=_check)
