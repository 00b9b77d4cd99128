"""Protocols that drive all electrodes at once, and read all of them.

Every one of them can read the potentials as `jeit.protocol.measurement_patterns` says. They count electrodes along a
ring, or as a solid's electrodes are numbered: any L - 1 independent patterns determine the transfer impedance, and with
it what every other protocol would read (`jeit.data.driven_by`).
"""

from __future__ import annotations

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike

from jeit.arguments import counted
from jeit.protocol._check import check_amplitude, check_count, check_current
from jeit.protocol.matrices import from_matrices
from jeit.protocol.patterns import Current
from jeit.protocol.potentials import Reading, measurement_patterns
from jeit.protocol.protocol import Protocol

# Patterns whose effect is a smaller share than this of the best one's are rounding.
_NOTHING = 1e-12


def trigonometric(
    num_electrodes: int,
    *,
    measurement: Reading = "adjacent",
    reference: int | None = None,
    current: Current = 1e-3,
) -> Protocol:
    """Sinusoidal currents in all electrodes at once: L - 1 drives, L(L - 1) channels.

    Drives are cos(θ), sin(θ), cos(2θ), sin(2θ), ... with θ = 2πl/L and amplitude `current` in amperes: the patterns
    that best distinguish a centred inclusion in a disk (Isaacson 1986; Gisser, Isaacson and Newell 1988). 16
    electrodes: 240. On a solid θ goes by the electrodes' numbers: complete, but no longer the best.

    - `measurement`, `reference`: as in `measurement_patterns`.

    Raises `ValueError` for a bad count, current or option.
    """
    count = check_count(num_electrodes, "trigonometric", 3)
    angle = 2 * np.pi * np.arange(count) / count
    waves = [wave(k * angle) for k in range(1, count // 2 + 1) for wave in (np.cos, np.sin)]
    drive = np.array(waves[: count - 1])
    drive -= drive.mean(axis=1, keepdims=True)  # the last rounding errors of Kirchhoff's law
    return _read_everywhere("trigonometric", drive, measurement, reference, current)


def haar(
    num_electrodes: int,
    *,
    measurement: Reading = "mean-removed",
    reference: int | None = None,
    current: Current = 1e-3,
) -> Protocol:
    """Haar wavelets over the electrodes' numbers: L - 1 orthogonal drives, coarse to fine, `current` amperes at most.

    The first drive sends current from the first half of the electrodes to the second, the next two do so within each
    half, and so on (Haar 1910). Where L is no power of two, halves differ by one electrode, and each of the larger one
    carries less, so that the sum is zero (unbalanced wavelets: Girardi and Sweldens 1997). Every L from 2 on.

    - `measurement`, `reference`: as in `measurement_patterns`.

    Raises `ValueError` for a bad count, current or option.
    """
    count = check_count(num_electrodes, "haar", 2)
    parts, drives = [np.arange(count)], []
    while parts:
        part = parts.pop(0)
        first, second = np.array_split(part, 2)
        pattern = np.zeros(count)
        pattern[first], pattern[second] = len(second), -len(first)
        drives.append(pattern / len(first))  # the first half is never the smaller one
        parts += [half for half in (first, second) if len(half) > 1]
    drive = np.array(drives)
    return _read_everywhere("haar", drive / np.abs(drive).max(axis=1, keepdims=True), measurement, reference, current)


def optimal(
    transfer: ArrayLike,
    other: ArrayLike | None = None,
    *,
    number: int | None = None,
    power: float | None = None,
    measurement: Reading = "mean-removed",
    reference: int | None = None,
    current: Current = 1e-3,
) -> Protocol:
    """The currents that best distinguish two bodies, best first: at most L - 1 drives.

    - `transfer`, `other`: (L, L) ohm, the transfer impedances of both bodies (`ForwardModel.transfer_impedance`, or
      measured: `jeit.data.transfer_impedance`). Without `other`, the eigenvectors of `transfer` itself.
    - `number`: of drives, all unless given; a difference of low rank has fewer.
    - Unless `power` is given: the I that make ‖(Z₁ - Z₂) I‖ largest for a given ‖I‖, singular vectors of the difference
      (Isaacson 1986; Gisser, Isaacson and Newell 1990), each then as large as `current`, the most that any electrode
      may carry, in amperes, lets it be.
    - `power`, watts: the I that make ‖(Z₁ - Z₂) I‖ largest for a given power Iᵀ Z₁ I (Cheney and Isaacson 1992), each
      dissipating so much in the first body. It needs `other`. `current` has no part in it.
    - `measurement`, `reference`: as in `measurement_patterns`.

    Raises `ValueError` for matrices that are not square, symmetric to a tenth, real and finite, or that are equal, for
    a `transfer` that dissipates nothing where `power` is given, and for bad options.
    """
    first = _checked("transfer", transfer)
    count = len(first)
    check_current(current, "optimal")
    most = count - 1 if number is None else check_count(number, "optimal: number", 1)
    # In an orthonormal basis of currents that sum to zero.
    basis = scipy.linalg.null_space(np.ones((1, count)))
    dissipated = basis.T @ first @ basis
    change = dissipated
    if other is not None:
        second = _checked("other", other)
        if second.shape != first.shape:
            raise ValueError(
                f"other: its shape is {second.shape}, and that of transfer {first.shape}; give one body's."
            )
        change = dissipated - basis.T @ second @ basis
    if np.linalg.norm(change) <= _NOTHING * np.linalg.norm(dissipated):
        raise ValueError("other: it equals transfer, and no current distinguishes them.")
    if power is None:
        values, directions = _sorted(np.linalg.eigh(change @ change))
    else:
        directions, values = _for_power(dissipated, change, power, other is None)
    keep = values > _NOTHING * values[0]
    drive = (basis @ directions[:, keep][:, :most]).T
    # An eigenvector has no sign: positive where it is largest.
    drive *= np.sign(drive[np.arange(len(drive)), np.abs(drive).argmax(axis=1)])[:, None]
    if power is None:
        drive /= np.abs(drive).max(axis=1, keepdims=True)
        return _read_everywhere("optimal", drive, measurement, reference, current)
    drive *= np.sqrt(power / np.einsum("si,ij,sj->s", drive, first, drive))[:, None]
    check_amplitude(float(np.abs(drive).max()), "optimal: power")
    return _read_everywhere("optimal for a given power", drive, measurement, reference, 1.0)


def _for_power(dissipated, change, power: float, alone: bool) -> tuple[np.ndarray, np.ndarray]:
    """Directions and their squared distinguishability, best first, for a given power."""
    if alone:
        raise ValueError("power needs other: with one body alone the currents for a given power are those of no power.")
    if isinstance(power, bool) or not isinstance(power, int | float) or not 0 < power < np.inf:
        raise ValueError(f"power must be a positive number of watts; it is {power!r}.")
    symmetric = (dissipated + dissipated.T) / 2
    if np.linalg.eigvalsh(symmetric)[0] <= 0:
        raise ValueError("transfer: some currents dissipate no power in it; is it the transfer impedance of a body?")
    values, directions = _sorted(scipy.linalg.eigh(change @ change, symmetric))
    return directions, values


def _sorted(found) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues and vectors, the largest first."""
    values, vectors = found
    return values[::-1], vectors[:, ::-1]


def _checked(name: str, given: ArrayLike) -> np.ndarray:
    matrix = np.asarray(given)
    if matrix.ndim == 3 and matrix.shape[1] == matrix.shape[2]:
        raise ValueError(
            f"{name} has shape {matrix.shape}, of {counted(len(matrix), 'frame')}; give one, (L, L): {name}[0] of the "
            "first, or their mean over axis 0."
        )
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1] or len(matrix) < 2 or matrix.dtype.kind not in "fiu":
        raise ValueError(f"{name} has shape {matrix.shape} of {matrix.dtype}; give real ohms, one row per electrode.")
    if not np.isfinite(matrix).all():
        raise ValueError(f"{name} contains NaN or infinity; leave out electrodes that are not known.")
    matrix = matrix.astype(float)
    if np.linalg.norm(matrix - matrix.T) > 0.1 * np.linalg.norm(matrix):
        raise ValueError(f"{name} is not symmetric, as the transfer impedance of every body is; is it one?")
    return (matrix + matrix.T) / 2


def _read_everywhere(kind: str, drive, measurement: Reading, reference: int | None, current: Current) -> Protocol:
    """Every drive with every reading."""
    check_current(current, kind)
    rows = measurement_patterns(drive.shape[1], measurement, reference)
    return from_matrices(current * drive, rows, name=f"{kind}, {measurement} measurement, {drive.shape[1]} electrodes")
