"""Effects in plain words: what a person who stands at the rig calls them, why they happen, and what to do."""

from __future__ import annotations

from dataclasses import dataclass, field

SHAPES = frozenset({"decay", "delay", "period", "width", "x", "y", "z", "radius", "exponent", "p"})
BOUNDED = frozenset({"fraction", "opacity", "probability", "start", "end", "detections"})  # cannot exceed 1
AXES = {
    "time": "along the time axis",
    "depth": "along depth",
    "wall": "across the wall",
    "scan": "over the course of the scan",
    "rate": "with the count rate",
}


@dataclass(frozen=True)
class EffectWords:
    """One effect for the report.

    Args:
        phrase: completes "Your simulation misses …".
        cause: the physics, one sentence.
        remedy: what to do on the rig, one sentence.
        headline: size of the effect, with ``{parameter}`` fields.
        kind: of its numbers: ``percent``, ``time`` (m of path), ``length`` (m), ``angle`` (rad), ``bins``,
            ``counts`` or ``plain``.
        kinds: parameters of another kind.
        nulls: values that mean "absent", where that is not 0.
    """

    phrase: str
    cause: str = ""
    remedy: str = ""
    headline: str = ""
    kind: str = "plain"
    kinds: dict[str, str] = field(default_factory=dict)
    nulls: dict[str, float] = field(default_factory=dict)

    def kind_of(self, parameter: str) -> str:
        """Kind of a parameter or reported quantity."""
        return self.kinds.get(parameter, self.kind)

    def null_of(self, parameter: str) -> float | None:
        """Value at which the effect is absent; None for a shape, which has none."""
        return None if parameter in SHAPES else self.nulls.get(parameter, 0.0)


def describe(name: str) -> EffectWords:
    """Words for an effect; one without an entry is called by its name."""
    return WORDS.get(name) or EffectWords(name.replace("_", " "))


WORDS = {
    "retroreflection": EffectWords(
        "a retroreflecting hidden surface",
        "The surface sends light back to where it came from (tape, signs, safety vests): brightness falls more slowly with "
        "distance and hardly with the angle.",
        "Cover the retroreflective parts, or keep the fitted exponents; a non-confocal scan is far less sensitive to it.",
        "falloff exponent {falloff} instead of 4, cosine exponent {cosine} instead of 1",
        nulls={"falloff": 4.0, "cosine": 1.0},
    ),
    "specular_lobe": EffectWords(
        "a glossy hidden surface",
        "Part of the light is reflected around the mirror direction, so spots that face the surface see it too bright.",
        "Make the surface matt where you can; a non-confocal scan shows the lobe's direction.",
        "lobe strength {strength}",
    ),
    "occlusion": EffectWords(
        "something opaque between the wall and the scene",
        "An object that returns no light itself shadows part of the scene for part of the wall.",
        "Look for a dark object at the place given and remove it, or scan a wider part of the wall to see around it.",
        "{opacity} of the light, at depth {z}, radius {radius}",
        "percent",
        {"x": "length", "y": "length", "z": "length", "radius": "length"},
    ),
    "higher_order_bounces": EffectWords(
        "light that bounced twice inside the hidden scene",
        "Surfaces that face each other exchange light, which arrives later than any direct path explains.",
        "Nothing to repair: keep it in the model, or darken one of the facing surfaces.",
        "{share} of the light",
        kinds={"share": "percent"},
    ),
    "time_offset": EffectWords(
        "a wrong time zero",
        "Cables, trigger or a re-zeroed histogram shift all arrival times by the same amount.",
        "Measure the arrival of the direct pulse at a known distance and correct the start of the time axis.",
        "{offset} late everywhere",
        "time",
    ),
    "time_drift": EffectWords(
        "a time zero that drifts during the scan",
        "Laser trigger and timing electronics wander as they warm up.",
        "Let the rig warm up, scan faster, or align every spot to its own direct pulse.",
        "{peak_to_peak} from end to end of its range",
        "time",
    ),
    "timing_jitter": EffectWords(
        "a time zero that jumps from spot to spot",
        "Each spot's histogram starts at a slightly different time: trigger, scanner settling, or per-spot alignment.",
        "Check the synchronisation between scanner and timing electronics; align every spot to its own direct pulse.",
        "σ = {sigma}",
        "time",
    ),
    "clock_scale": EffectWords(
        "a time axis that is stretched",
        "The true width of a time bin is not the nominal one.",
        "Calibrate the bin width with a known delay or with the laser's repetition period.",
        "bins {scale} wider than stated",
        "percent",
    ),
    "wall_tilt": EffectWords(
        "a relay wall that is tilted against the scan's plane",
        "The scanned points stand nearer or farther than assumed, so paths are longer on one side.",
        "Measure the wall's plane (the direct pulse's arrival tells it) and give the true wall points.",
        "{tilt_x} along x, {tilt_y} along y",
        "angle",
    ),
    "laser_sensor_baseline": EffectWords(
        "laser and sensor spots that do not coincide",
        "The detector looks beside the point that the laser lights.",
        "Realign the two beams on the wall, or give the sensor's true points.",
        "{baseline_x} along x, {baseline_y} along y",
        "length",
    ),
    "irf_tail": EffectWords(
        "a slow detector tail",
        "In a silicon SPAD some carriers are born outside the junction and diffuse into it late.",
        "Measure the instrument response on the direct pulse and use it; a thinner detector or a shorter wavelength has less tail.",
        "{fraction} of the photons, τ = {decay}",
        "percent",
        {"decay": "time"},
    ),
    "ghost_pulse": EffectWords(
        "a second, delayed pulse",
        "A reflection in the optics or a cable, or a post-pulse of the laser, repeats every return later.",
        "Look for the repeat in the direct pulse; tilt filters and windows, terminate cables, or move it out of the gate.",
        "{fraction} of the main pulse, {delay} later",
        "percent",
        {"delay": "time"},
    ),
    "power_drift": EffectWords(
        "a laser power that drifts during the scan",
        "Laser output or detector efficiency changes with temperature while the scan runs.",
        "Warm up the laser, record a power monitor, or divide each spot by its direct pulse.",
        "{peak_to_peak} from end to end of its range",
        "percent",
    ),
    "wall_reflectance": EffectWords(
        "a relay wall that is brighter in some places than in others",
        "Paint, stains or texture change how much light each wall point passes on.",
        "Repaint the wall, or measure its gain with the direct pulse and divide by it.",
        "{rms} rms over the wall",
        "percent",
    ),
    "vignetting": EffectWords(
        "a brightness that changes from the middle of the scan to its edge",
        "Lens, mirrors or an aperture pass less light at the edge of the field.",
        "Open the aperture, re-centre the optics, or measure a flat field.",
        "{strength} darker at the edge (log gain)",
        "percent",
    ),
    "ambient_map": EffectWords(
        "a background that differs over the wall",
        "Lamps, windows or screens light parts of the wall.",
        "Shield the wall or use a narrower filter; keep the map where you cannot.",
        "{rms} rms over the wall",
        "percent",
    ),
    "hot_spots": EffectWords(
        "a few spots with far too much background",
        "Single spots look at a reflection, a status lamp, or were recorded while someone opened a door.",
        "Look at these spots on the wall; mask or record them again.",
        "{number} spots with {level} more",
        kinds={"level": "counts", "extra": "counts"},
    ),
    "background_slope": EffectWords(
        "a background that rises or falls over the time gate",
        "Slow light (fluorescence, the laser's pedestal) or a detector that recovers after the direct pulse.",
        "Record once with the hidden scene covered, and subtract nothing but model that shape.",
        "{slope} from the middle of the gate to its end",
        "percent",
    ),
    "direct_leak": EffectWords(
        "direct light that leaks into the gate",
        "The end of the very bright first return is still there when the gate opens.",
        "Open the gate later, or block the direct path between laser spot and detector.",
        "{amplitude} when the gate opens, τ = {decay}",
        "counts",
        {"decay": "time"},
    ),
    "pile_up": EffectWords(
        "pile-up (early photons hide later ones)",
        "The detector counts at most one photon a laser cycle, so a high rate distorts the histogram towards early times.",
        "Attenuate to below 5 % detections a cycle, or gate out the direct pulse.",
        "{detections} counts recorded a laser cycle",
    ),
    "afterpulsing": EffectWords(
        "afterpulsing (counts that trigger further counts)",
        "Carriers trapped in the detector are released later and are counted again.",
        "Lengthen the hold-off time, lower the excess bias, or warm the detector a little.",
        "{probability} of the counts, τ = {decay}",
        "percent",
        {"decay": "time"},
    ),
    "tcspc_nonlinearity": EffectWords(
        "time bins of unequal width",
        "The timing electronics' bins are not equally wide; the pattern repeats with the interpolator's period.",
        "Record a flat histogram with steady light and divide by it.",
        "{amplitude} with a period of {period}",
        "percent",
        {"period": "bins"},
    ),
    "gate_edges": EffectWords(
        "a time gate with soft edges",
        "The detector is not fully sensitive right after the gate opens and before it closes.",
        "Fit a narrower gate, or measure its shape with steady light.",
        "{start} lost at the first bin, {end} at the last",
        "percent",
        {"width": "bins"},
    ),
}
