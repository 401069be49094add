"""What reference signals share: rules for frequencies and lists."""

from collections.abc import Sequence

from pea_core.params import ParameterError


def below_nyquist(name: str, frequency_hz: float, T_s: float) -> None:
    """Refuse a frequency (Hz) that samples every T_s (s) cannot tell from a lower one.

    Raises
    ------
    ParameterError
        It is not below half the sample rate.
    """
    if frequency_hz * T_s >= 0.5:
        raise ParameterError(
            f"{name} = {frequency_hz:g}: must be below half the sample rate ({0.5 / T_s:g} Hz)"
        )


def one_each(name: str, values: Sequence[float], count: int) -> tuple[float, ...]:
    """`values`, or its only value repeated, one for each of `count` frequencies.

    Raises
    ------
    ParameterError
        Neither one value nor `count` of them.
    """
    if len(values) not in (1, count):
        raise ParameterError(
            f"{name} has {len(values)} values: give one, or one for each of the "
            f"{count} frequencies_hz"
        )
    return tuple(values) if len(values) == count else (values[0],) * count


def some(name: str, values: Sequence[float]) -> None:
    """Refuse an empty list.

    Raises
    ------
    ParameterError
        There is no value in it.
    """
    if not values:
        raise ParameterError(f"{name} is empty: give at least one value")
