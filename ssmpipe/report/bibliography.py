"""References by the keys that stages cite."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Reference:
    """One work: formatted text and, where it has one, its DOI or address."""

    text: str
    doi: str = ""
    url: str = ""


REFERENCES = {
    "li2015": Reference(
        "Li K. Direct diffeomorphic reparameterization for correspondence optimization in statistical shape modeling. "
        "PhD thesis, Illinois Institute of Technology, Chicago, 2015."
    ),
    "davies2002": Reference(
        "Davies RH, Twining CJ, Cootes TF, Waterton JC, Taylor CJ. A minimum description length approach to statistical shape "
        "modeling. IEEE Transactions on Medical Imaging 21(5):525–537, 2002.",
        "10.1109/TMI.2002.1009388",
    ),
    "thodberg2003": Reference(
        "Thodberg HH. Minimum description length shape and appearance models. Information Processing in Medical Imaging, "
        "LNCS 2732:51–62, 2003.",
        "10.1007/978-3-540-45087-0_5",
    ),
    "thodberg2003curvature": Reference(
        "Thodberg HH, Olafsdottir H. Adding curvature to minimum description length shape models. British Machine Vision "
        "Conference, 2003."
    ),
    "styner2003": Reference(
        "Styner MA, Rajamani KT, Nolte LP, Zsemlye G, Székely G, Taylor CJ, Davies RH. Evaluation of 3D correspondence methods "
        "for model building. Information Processing in Medical Imaging, LNCS 2732:63–75, 2003.",
        "10.1007/978-3-540-45087-0_6",
    ),
    "taubin1995": Reference(
        "Taubin G. A signal processing approach to fair surface design. SIGGRAPH 95, 351–358, 1995.",
        "10.1145/218380.218473",
    ),
    "garland1997": Reference(
        "Garland M, Heckbert PS. Surface simplification using quadric error metrics. SIGGRAPH 97, 209–216, 1997.",
        "10.1145/258734.258849",
    ),
    "yoshizawa2004": Reference(
        "Yoshizawa S, Belyaev A, Seidel HP. A fast and simple stretch-minimizing mesh parameterization. Shape Modeling "
        "International, 200–208, 2004.",
        "10.1109/SMI.2004.1314507",
    ),
    "floater2003": Reference(
        "Floater MS. Mean value coordinates. Computer Aided Geometric Design 20(1):19–27, 2003.",
        "10.1016/S0167-8396(03)00002-5",
    ),
    "pinkall1993": Reference(
        "Pinkall U, Polthier K. Computing discrete minimal surfaces and their conjugates. Experimental Mathematics 2(1):15–36, 1993.",
        "10.1080/10586458.1993.10504266",
    ),
    "besl1992": Reference(
        "Besl PJ, McKay ND. A method for registration of 3-D shapes. IEEE Transactions on Pattern Analysis and Machine "
        "Intelligence 14(2):239–256, 1992.",
        "10.1109/34.121791",
    ),
    "chen1992": Reference(
        "Chen Y, Medioni G. Object modelling by registration of multiple range images. Image and Vision Computing "
        "10(3):145–155, 1992.",
        "10.1016/0262-8856(92)90066-C",
    ),
    "gower1975": Reference(
        "Gower JC. Generalized Procrustes analysis. Psychometrika 40(1):33–51, 1975.", "10.1007/BF02291478"
    ),
    "goodall1991": Reference(
        "Goodall C. Procrustes methods in the statistical analysis of shape. Journal of the Royal Statistical Society B "
        "53(2):285–339, 1991.",
        "10.1111/j.2517-6161.1991.tb01825.x",
    ),
    "osada2002": Reference(
        "Osada R, Funkhouser T, Chazelle B, Dobkin D. Shape distributions. ACM Transactions on Graphics 21(4):807–832, 2002.",
        "10.1145/571647.571648",
    ),
    "piegl1997": Reference(
        "Piegl L, Tiller W. The NURBS Book. 2nd edition, Springer, 1997.", "10.1007/978-3-642-59223-2"
    ),
    "liu1989": Reference(
        "Liu DC, Nocedal J. On the limited memory BFGS method for large scale optimization. Mathematical Programming "
        "45:503–528, 1989.",
        "10.1007/BF01589116",
    ),
    "cootes1995": Reference(
        "Cootes TF, Taylor CJ, Cooper DH, Graham J. Active shape models: their training and application. Computer Vision and "
        "Image Understanding 61(1):38–59, 1995.",
        "10.1006/cviu.1995.1004",
    ),
    "libigl": Reference(
        "Jacobson A, Panozzo D, and others. libigl: a simple C++ geometry processing library, 2018.",
        url="https://libigl.github.io",
    ),
    "trimesh": Reference("Dawson-Haggerty M, and others. trimesh, 2019.", url="https://trimesh.org"),
    "harris2020": Reference(
        "Harris CR, and others. Array programming with NumPy. Nature 585:357–362, 2020.", "10.1038/s41586-020-2649-2"
    ),
    "virtanen2020": Reference(
        "Virtanen P, and others. SciPy 1.0: fundamental algorithms for scientific computing in Python. Nature Methods "
        "17:261–272, 2020.",
        "10.1038/s41592-019-0686-2",
    ),
    "hunter2007": Reference(
        "Hunter JD. Matplotlib: a 2D graphics environment. Computing in Science & Engineering 9(3):90–95, 2007.",
        "10.1109/MCSE.2007.55",
    ),
}

SOFTWARE = ("harris2020", "virtanen2020", "libigl", "trimesh")


def reference(key: str) -> Reference:
    """Return the reference of a key; a key that nobody knows is shown as itself rather than dropped.

    Examples
    --------
    >>> reference("besl1992").doi
    '10.1109/34.121791'
    >>> reference("nobody1900").text
    'nobody1900 (no reference on file)'
    """
    return REFERENCES.get(key, Reference(f"{key} (no reference on file)"))


def numbered(keys: Iterable[str]) -> dict[str, int]:
    """Number keys by first appearance, from 1.

    Examples
    --------
    >>> numbered(["b", "a", "b"])
    {'b': 1, 'a': 2}
    """
    return {key: i for i, key in enumerate(dict.fromkeys(keys), start=1)}
