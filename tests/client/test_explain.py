"""`probeless explain`: the plan of a frame in words, of the gallery's scenes and of any other source."""

from __future__ import annotations

import pytest

from client.cli import run_command
from client.commands.explain import PURPOSES, lines
from client.errors import SourceError
from client.gallery.scenes import GALLERY
from client.options.source import open_source
from protocol.messages import LeftOut, Plan
from server.effects.table import effect_names
from server.transfer.kept_bounds import MEASURED


def test_every_effect_has_a_purpose() -> None:
    assert PURPOSES.keys() == {*effect_names("picture"), *effect_names("layer")}


def test_a_plan_is_said_an_effect_a_line() -> None:
    left_out = (
        LeftOut(effect="reflect", reason="nothing is glossy", error_bound=0.0),
        LeftOut(effect="shadow_real", reason="far away", error_bound=0.25),
        LeftOut(effect="bounce_real", reason="far away", error_bound=0.25),
        LeftOut(effect="light_objects", reason="dark", error_bound=0.5),
        LeftOut(effect="refine_real", reason="asked for", error_bound=255.0),
        LeftOut(effect="lamplight", reason="not drawn", error_bound=None),
        LeftOut(effect="shadows_of_known_places", reason=f"kept; {MEASURED}", error_bound=11.3),
    )
    text = list(lines("a source, frame 3", Plan(run=("composite",), left_out=left_out)))
    assert text[0] == "a source, frame 3: 1 effects run, 7 are left out."
    said = {line.split()[0]: line for line in text[2:]}
    assert "puts the picture together" in said["composite"]
    assert said["reflect"].endswith("nothing is glossy (changes nothing)")
    assert said["shadow_real"].endswith("(changes no pixel by more than 0.25/255)")
    assert said["refine_real"].endswith("asked for (change not bounded)")
    assert said["lamplight"].endswith("(change unknown)")
    assert said["shadows_of_known_places"].endswith("(changes at most one pixel in a thousand by more than 11.30/255)")
    assert "change no pixel by more than 0.75/255" in text[-1]  # one reason counts once


def test_the_gallery_is_explained_with_its_own_things(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["explain", "synthetic:gallery/sharp-sun", "--frame", "0"]) == 0
    said = capsys.readouterr().out
    assert "direct_real" in said.partition("Left out:")[0]
    assert "no virtual object in view is glossy" in said


def test_a_frame_that_there_is_not_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["explain", "synthetic:gallery/nothing", "--frame", "99"]) == 2
    assert "the source has frames 0:6" in capsys.readouterr().err
    with pytest.raises(SourceError, match="there are nothing, elsewhere"):
        open_source("synthetic:gallery/nix")


def test_the_gallery_is_as_large_as_promised() -> None:
    assert len(GALLERY) >= 12
    assert len({scene.expected_effects(0) for scene in GALLERY.values()}) >= 8  # scenes differ in what they call for
    called_for = set().union(
        *(scene.expected_effects(index) for scene in GALLERY.values() for index in range(scene.frames))
    )
    presets = {"draw_depth_views", "refine_virtual", "refine_real"}
    assert {*effect_names("picture")} - presets <= called_for
