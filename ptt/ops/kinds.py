"""What kind of thing an argument is, said in one sentence where it is another."""

from __future__ import annotations

MADE_BY = {
    "BRDFBasis": "BRDFBasis.fit makes one",
    "BRDFSpace": "such as BRDFSpace.ggx()",
    "BlinnPhong": "or GGX(f0, roughness), or Named(name, f) of a function of your own",
    "Camera": "such as scene.camera",
    "Clusters": "such as ptt.Clusters(points=1000)",
    "Environment": "Environment.load reads a file",
    "RawTransfer": "ptt.precompute makes one",
    "Scene": "ptt.load_scene reads a file",
    "TensorBRDF": "TensorBRDF.fit makes one",
    "Transfer": "ptt.assemble makes one",
    "TransferModel": "ptt.compress makes one, TransferModel.load reads a file",
}
"""How a user comes by an object of a class."""


def check(name: str, given: object, kind: type | tuple[type, ...]) -> None:
    """Refuse an argument of another class; kind: the class, or the one to name first and others that serve, too.

    Raises:
        ValueError: `given` is no instance of any.
    """
    if isinstance(given, kind):
        return
    usual = kind[0] if isinstance(kind, tuple) else kind
    raise ValueError(f"{name} must be a ptt.{usual.__name__} ({MADE_BY[usual.__name__]}), got {type(given).__name__}")
