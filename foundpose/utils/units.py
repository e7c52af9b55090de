"""One check of units: lengths that belong together and differ by what looks like metres against millimetres."""


class UnitError(ValueError):
    """Two lengths that belong together are not in the same unit."""


def check_unit(length: float, name: str, reference: float, reference_name: str, most: float = 100.0) -> None:
    """Make sure that a length and one that it belongs with differ by no more than a factor.

    Args:
        length: the length.
        name: what it is, with its file.
        reference: the other length.
        reference_name: what that is, with its file.
        most: the factor.

    Raises:
        UnitError: they differ by more.
    """
    if not length > 0 or not reference > 0 or 1 / most <= length / reference <= most:
        return
    raise UnitError(
        f"{name} is {length:.4g} and {reference_name} is {reference:.4g}, a factor of {length / reference:.3g}: are "
        "they in the same unit? Metres beside millimetres are 1000 times off; BOP has millimetres throughout"
    )
