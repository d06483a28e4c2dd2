"""What a compressed model shows: the scene's own materials, what may be chosen, and nothing that it cannot."""

from __future__ import annotations

from dataclasses import replace

import pytest

import ptt

SKY = ptt.Environment.gradient_sky()


def test_what_may_be_chosen_is_shown(small_scene: ptt.Scene, small_raw: ptt.RawTransfer) -> None:
    """A scene of Blinn-Phong shows a fabric where that is said, and as a space of the fabric alone shows it."""
    fabric = ptt.fitted("red-fabric")
    model = ptt.compress(small_raw, 64, clusters=None, editable=[fabric])
    assert "blinn-phong, cook-torrance" in repr(model)
    given = {"ball": fabric}
    found = ptt.TransferRelighter(model)(SKY, given, small_scene.camera)
    fitted = ptt.BRDFSpace.holding([fabric])
    alone = ptt.compress(small_raw, 64, ptt.TensorBRDF.fit(fitted, ptt.usual_ranks(fitted), separated=0), clusters=None)
    expected = ptt.TransferRelighter(alone)(SKY, given | {"floor": ptt.lambert(0.6)}, small_scene.camera)
    assert ptt.relative_rmse(found, expected) < 0.05
    with pytest.raises(ValueError, match="holds blinn-phong shapes, got cook-torrance"):
        ptt.TransferRelighter(ptt.compress(small_raw, 64, clusters=None))(SKY, given, small_scene.camera)


def test_what_cannot_be_shown_is_refused_before_it_takes_long(small_raw: ptt.RawTransfer) -> None:
    brdf = ptt.TensorBRDF.fit(ptt.BRDFSpace.ggx((0.3, 0.5)), ranks=(2, 4, 4), separated=0)
    own = small_raw.receivers
    shiny = replace(own, materials=own.materials | {"floor": ptt.blinn_phong()})  # fixed
    with pytest.raises(ValueError, match="region 'floor': the model's space holds ggx shapes, got blinn-phong"):
        ptt.compress(replace(small_raw, receivers=shiny), 64, brdf, clusters=None)
    with pytest.raises(ValueError, match="editable is for the brdf that is made here"):
        ptt.compress(small_raw, 64, brdf, clusters=None, editable=[ptt.ggx()])
    blend = ptt.Material(0.1, 1.0, ptt.Blend((ptt.GGX(0.1, 0.4), ptt.GGX(0.1, 0.5)), (0.5, 0.5)))
    blended = replace(own, materials=own.materials | {"ball": blend})
    with pytest.raises(ValueError, match="a space of its own is for analytic and named shapes"):
        ptt.compress(replace(small_raw, receivers=blended), 64, clusters=None)
