"""Series of one change at a time, everything else equal: what the choices of this project were made by."""

from experiments.jobs import SEEDS
from experiments.paper import SCENES
from experiments.series.series import Experiment, Series
from experiments.variants import COHERENT, PRECISIONS, TO_OURS

_OPTIMISERS = ("adam_4e-3", "adam_1.6e-2", "muon_5e-3", "muon_1e-2", "muon_2e-2")
_LEARNING_RATES = ("lr_1e-3", "lr_2e-3", "", "lr_8e-3", "lr_1.6e-2", "lr_3.2e-2")
"""None: the presets' 4e-3."""
_INPUTS = ("paper_inputs", "raw_gigahertz", "sphere", "area", "octaves_10", "frequency_octaves_0", "frequency_octaves_1")
_SIZES = ("octaves_3_2", "gaussians_1000", "gaussians_4000", "width_128", "lr_3e-3", "weight_decay_0.1", "fixed_means")
_ROOMS = ("2", "3", "4", "5")
SCENE_OF_CURVE = "4"
"""It has the whole curve."""
_OTHERS = tuple(scene for scene in SCENES if scene != SCENE_OF_CURVE)

CHOICES = Experiment(
    # Of the wideband field (docs/history.md, docs/performance.md). The profiles are the `cpu` preset as it was when the choices
    # were made, with and without octaves of the frequency.
    "Choices",
    (
        Series(
            "Inputs, projection, starting points, density control",
            "wideband",
            ("", *_INPUTS, "no_density_control", "density_with_reset"),
            "choices_octaves4",
            seeds=(0, 1),
        ),
        Series(
            "Frequencies that were not trained, with four octaves",
            "wideband",
            ("", "raw_gigahertz", "no_frequency", "frequency_octaves_0", "frequency_octaves_1"),
            "choices_octaves4",
            combination="C3",
        ),
        Series(
            "Frequencies that were not trained, without octaves",
            "wideband",
            ("", "frequency_octaves_4", "no_frequency"),
            "choices",
            combination="C3",
        ),
        Series(
            "The layer at which the query enters",
            "wideband",
            ("fusion_0", "fusion_1", "fusion_2", "fusion_3"),
            "choices",
            scenes=("1", "2", "4"),
            seeds=(0, 1),
        ),
        Series("Batches, with steps that take equal time", "wideband", ("batch_4", "batch_8", "batch_16"), "choices"),
        Series("Sizes, rates and what is trained", "wideband", ("", *_SIZES), "choices"),
    ),
)
TUNING = Experiment(
    # One changed at a time, tuned alike: all have the effort of the profile `quick` and are scored at the held-out transmitters
    # that the slowest one is scored at. docs/baselines.md quotes the tables.
    "Tuning of the trained baselines",
    (
        Series("Learning rates", "wideband", _LEARNING_RATES, "tuning"),
        Series("Learning rates, density control", "wrfgs", (*_LEARNING_RATES, "no_density_control"), "tuning"),
        Series(
            "Learning rates, loss, directions, inputs",
            "nerf2",
            (*_LEARNING_RATES, "l2", "directions_384", "paper_inputs"),
            "tuning",
        ),
    ),
)
RATES = Experiment(
    # Of every trained model, with equal numbers of spectra. On validation.
    "Optimisers",
    (
        Series("Wideband", "wideband", _OPTIMISERS, "rates", scenes=("4",)),
        Series("WRF-GS, a model a frequency", "wrfgs", _OPTIMISERS, "rates", scenes=("4",)),
        Series("NeRF2", "nerf2", _OPTIMISERS, "rates", scenes=("4",)),
        Series(
            "The coherent field, rates of its materials (the preset has 1e-2)",
            "wave",
            ("materials_lr_5e-3", "", "materials_lr_2e-2"),
            "rates",
            scenes=("4",),
        ),
    ),
)
CURVE = Experiment(
    # One, five and ten times 8,000 spectra, on the held-out transmitters, by today's presets. WRF-GS as the paper has it, a
    # model a frequency which shares that number with the others, and pooled: one model for all frequencies. Scene 4 has the
    # whole curve, the other scenes its first point. The costliest points have one seed.
    "Spectra seen",
    (
        Series("Wideband", "wideband", ("", "long"), "quick", (SCENE_OF_CURVE,), seeds=SEEDS),
        Series("Wideband, ten times as many", "wideband", ("longest",), "quick", (SCENE_OF_CURVE,)),
        Series("WRF-GS, pooled", "wideband", ("pooled", "pooled_long"), "quick", (SCENE_OF_CURVE,), seeds=SEEDS),
        Series("WRF-GS, pooled, ten times as many", "wideband", ("pooled_longest",), "quick", (SCENE_OF_CURVE,)),
        Series("WRF-GS, a model a frequency", "wrfgs", ("", "long"), "quick", (SCENE_OF_CURVE,), seeds=SEEDS),
        Series("WRF-GS, a model a frequency, ten times as many", "wrfgs", ("longest",), "quick", (SCENE_OF_CURVE,)),
        Series("NeRF2", "nerf2", ("",), "quick", (SCENE_OF_CURVE,), seeds=SEEDS),
        Series("NeRF2, five times as many", "nerf2", ("long",), "quick", (SCENE_OF_CURVE,)),
        Series("Wideband, other scenes", "wideband", ("",), "quick", _OTHERS, seeds=SEEDS),
        Series("WRF-GS, a model a frequency, other scenes", "wrfgs", ("",), "quick", _OTHERS, seeds=SEEDS),
        Series("WRF-GS, pooled, other scenes", "wideband", ("pooled",), "quick", _OTHERS),
    ),
)
ROOMS = Experiment(
    # A whole room is the test, of which nothing has been trained. By today's presets.
    "A room held out",
    (
        Series("Wideband", "wideband", ("room",), "rooms", _ROOMS),
        Series("WRF-GS, pooled", "wideband", ("room_pooled",), "rooms", _ROOMS),
        Series("The coherent field", "wave", ("room",), "rooms", _ROOMS),
    ),
)
SCHEDULES = Experiment(
    # How fast the wideband field learns, and for how long: learning rates, warm-up, number of steps. On validation.
    "Schedules",
    (
        Series("The `cpu` preset of today", "wideband", ("",), "main", ("1", "2", "4")),
        Series(
            "Behind walls, beside the former 6,000 steps", "wideband", ("", "warm_8e-3", "steps_6000"), "schedules", ("2", "4")
        ),
        Series(
            "Learning rates", "wideband", ("", "lr_8e-3", "lr_1.6e-2", "warm_8e-3", "warm_1.6e-2", "warm_2.4e-2"), "schedules"
        ),
    ),
)
FREQUENCY = Experiment(
    # What the frequency is to the networks of the wideband field, where it matters: behind walls. On validation. All but the
    # first see it; `variants.FREQUENCY` says how.
    "Frequency",
    (
        Series(
            "1,000 steps of Adam",
            "wideband",
            ("f_off", "f_input", "f_degree_4", "f_heads_2", "f_heads_4", "f_both"),
            "frequency",
            scenes=("2",),
        ),
    ),
)
PAPER_FORM = Experiment(
    # Preset `paper`: as whole as an hour on one core allows, and change by change on the way to ours.
    "The paper's form",
    (
        Series("As many Gaussians and steps as an hour allows", "wideband", ("",), "paper_form"),
        Series(
            "From the paper's form to ours, every row with all changes above it: equally many spectra, scores of validation",
            "wideband",
            ("", *TO_OURS),
            "to_ours",
            scenes=("4",),
        ),
        Series(
            "What the networks multiply, by 2,000 spectra, scores of validation",
            "wideband",
            PRECISIONS,
            "precision",
            seeds=(0, 1),
        ),
    ),
)
WAVE_CHOICES = Experiment(
    # One part taken away at a time (docs/history.md).
    "Parts of the coherent field",
    (Series("All of it, and without a part", "wave", ("", *COHERENT), "choices", scenes=("4",)),),
)
