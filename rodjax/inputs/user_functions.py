"""A user's functions, tried once where they are given, so that a slip is answered there.

A function is traced for shapes only, as the library will trace it later; nothing is computed.
"""

from collections.abc import Callable

import jax

from rodjax.inputs.validation import as_float, check_numbers, shown


def returned(name: str, function: Callable, *arguments) -> jax.ShapeDtypeStruct:
    """Shape of the array of real numbers that a function returns.

    Args:
        name: of the argument by which the function was given, for messages.
        arguments: arrays, or what has their shape and kind, in any pytrees.

    Raises:
        ValueError: it cannot be traced (numpy, or Python's `if`, on traced values), it fails, or
            it returns something else.
    """

    def tried(*arguments):
        value = as_float(called(name, function, *arguments))
        try:
            check_numbers(value=value)
        except ValueError:
            raise ValueError(
                f"{name}: {named(function)} must return an array of real numbers, got"
                f" {shown(value)}"
            ) from None
        return value

    return jax.eval_shape(tried, *arguments)


def called(name: str, function: Callable, *arguments, hint: str = ""):
    """What a function returns; ValueError with its name where it fails, with a hint besides."""
    try:
        return function(*arguments)
    except jax.errors.JAXTypeError as error:  # by numpy, `if`, `float` of a traced value
        raise ValueError(
            f"{name}: {named(function)} cannot be traced by jax; write it with jax.numpy"
            " instead of numpy, and jnp.where instead of `if`"
        ) from error
    except Exception as error:
        first = str(error).partition("\n")[0]
        if isinstance(error, ValueError) and first.partition(":")[0].isidentifier():
            raise  # it names an argument already
        raise ValueError(
            f"{name}: {named(function)} failed when it was tried:"
            f" {type(error).__name__}: {first}{'; ' if hint else ''}{hint}"
        ) from error


def named(function: Callable) -> str:
    """A function in a message: its name, and of plain ones where it stands."""
    code = getattr(function, "__code__", None)
    name = getattr(function, "__qualname__", type(function).__name__)
    where = "" if code is None else f" ({code.co_filename}:{code.co_firstlineno})"
    return f"the function `{name}`{where}"


def check_function(**functions) -> None:
    """Raise ValueError unless each can be called, and kept as a static part of a traced program."""
    for name, function in functions.items():
        if isinstance(function, type) or not callable(function):
            raise ValueError(f"{name}: must be a function, got {shown(function)}")
        try:
            hash(function)
        except TypeError:
            raise ValueError(
                f"{name}: must be hashable, as plain functions are; give arrays that it needs as"
                " parameters"
            ) from None
