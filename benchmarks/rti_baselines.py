"""What software for relightable images (RTI) does between lights: fits of display values over the lights' directions, to compare with.

Each fit is linear in the images, so that it is a matrix from the images of the captured lights to those of wanted ones.

Source: Malzbender, Gelb and Wolters, "Polynomial texture maps", SIGGRAPH 2001; Gautron et al., "A novel hemispherical basis", EGSR 2004;
radial basis functions over the disc of directions, Giachetti et al., "A novel framework for highlight reflectance transformation
imaging", CVIU 2018; Duchon, "Splines minimizing rotation-invariant semi-norms in Sobolev spaces", 1977 (the biharmonic one).
"""

import numpy as np
from numpy.typing import NDArray

from kernels.relight.basis.rti import biquadratic, hemispherical_harmonics

Matrix = NDArray[np.float64]

WIDTHS = np.geomspace(0.03, 2.0, 25)
"""Tried widths σ of Gaussians, in the unit of the disc's radius; the one that predicts left-out captured images best is taken."""
RIDGE = 1e-6
"""Added to the diagonal of Gaussians; wide ones are nearly dependent."""
SILENT = 1e-15
"""Least squared distance on the disc, so that its logarithm is finite."""


def rti_fits(captured: Matrix, wanted: Matrix, images: Matrix) -> dict[str, Matrix]:
    """Return the weight of each captured image in each wanted one, by name of the fit.

    Args:
        captured: [lights, 3] unit vectors to the captured lights, z > 0.
        wanted: [n, 3] unit vectors to the wanted lights, z > 0.
        images: [lights, values] display values of the captured lights, on which the width of Gaussians is chosen.

    Returns:
        Matrices [n, lights]; the fits of PTM and HSH with 9 and 16 terms, and radial basis functions: Gaussians, which the ridge lets
        smooth over noise where lights are close together, and biharmonic ones, which interpolate.
    """
    # the pseudo-inverse, as such software has it: relit itself refuses HSH with 16 terms where lights are on a part of the hemisphere
    fits = {"PTM": biquadratic(wanted) @ np.linalg.pinv(biquadratic(captured))}
    for terms in (9, 16):
        fits[f"HSH {terms}"] = hemispherical_harmonics(wanted, terms) @ np.linalg.pinv(hemispherical_harmonics(captured, terms))
    fits["RBF, Gaussian"] = _gaussian(captured, wanted, images)
    squares_in, squares_out = _squares(captured, captured), _squares(wanted, captured)
    fits["RBF, biharmonic"] = _interpolation(_biharmonic(squares_in), _biharmonic(squares_out), _affine(captured), _affine(wanted))
    return fits


def _gaussian(captured: Matrix, wanted: Matrix, images: Matrix) -> Matrix:
    squares_in, squares_out = _squares(captured, captured), _squares(wanted, captured)
    ones_in, ones_out = np.ones((len(captured), 1)), np.ones((len(wanted), 1))

    def missed(width: float) -> float:
        """Return the mean squared error of captured images, each predicted from the others (Dubrule 1983: no second solution)."""
        inverse = np.linalg.inv(_bordered(np.exp(-squares_in / (2 * width**2)) + RIDGE * np.eye(len(captured)), ones_in))
        own = inverse[: len(captured), : len(captured)]
        return float(np.mean((own @ images / np.diag(own)[:, None]) ** 2))

    width = min(WIDTHS, key=missed)
    return _interpolation(np.exp(-squares_in / (2 * width**2)) + RIDGE * np.eye(len(captured)), np.exp(-squares_out / (2 * width**2)),
                          ones_in, ones_out)


def _interpolation(inner: Matrix, outer: Matrix, functions_in: Matrix, functions_out: Matrix) -> Matrix:
    """Return the weights of radial basis functions with a polynomial that they do not take part in."""
    rows = np.concatenate([outer, functions_out], axis=1)
    return np.asarray(np.linalg.solve(_bordered(inner, functions_in), rows.T).T[:, : len(inner)])


def _bordered(inner: Matrix, functions: Matrix) -> Matrix:
    return np.block([[inner, functions], [functions.T, np.zeros((functions.shape[1],) * 2)]])


def _squares(a: Matrix, b: Matrix) -> Matrix:
    return np.asarray(((a[:, None, :2] - b[None, :, :2]) ** 2).sum(axis=2))


def _biharmonic(squares: Matrix) -> Matrix:
    return np.asarray(squares * np.log(np.maximum(squares, SILENT)))


def _affine(directions: Matrix) -> Matrix:
    return np.concatenate([np.ones((len(directions), 1)), directions[:, :2]], axis=1)
