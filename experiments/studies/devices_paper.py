"""Times on paper of a step on more devices than there are here, from its measured parts.

    T(D, B) = shared + spectrum B / D + exchange(D)        exchange(D) = 2 (D - 1) / D  bytes / bandwidth + 2 log2(D) latency

A step of B links on D devices: what every device does for itself (projection, sorting, the layers of the networks that see the
Gaussians alone), its part of the links, and an all-reduce of the gradients along trees. Bandwidth and latency are assumed, all
else is measured.
"""

import math
from typing import Any

DEVICES = (1, 2, 4, 8, 16, 32, 64)
LINKS = {"within_a_machine": (100e9, 5e-6), "between_machines": (10e9, 30e-6)}
"""Bytes a second and seconds of latency: NVLink or PCIe 5, and 100-gigabit Ethernet."""
FASTER = {"cpu": 1.0, "fifty_times": 50.0}
"""Factors by which a device computes faster than the measured processor; the exchange does not become faster with it."""
SCENES, FIXED = 1000, 64
"""Scenes, and the links of a batch that all sizes share in strong scaling."""
SCENE_S = 700.0
"""Seconds per scene with the hybrid field's `cpu` preset (docs/architecture.md: `Field.seconds`), on two cores."""


def step_s(parts: dict[str, Any], devices: int, batch: int, link: str, faster: float = 1.0) -> float:
    """Returns the time of a step on paper."""
    bandwidth, latency = LINKS[link]
    computed = (parts["shared_s"] + parts["spectrum_s"] * batch / devices) / faster
    exchange = 2 * (devices - 1) / devices * parts["gradient_bytes"] / bandwidth + 2 * math.log2(devices) * latency
    return float(computed + exchange)


def scaling(parts: dict[str, Any], link: str, faster: float) -> dict[str, Any]:
    """Returns, by number of devices, the speed-up of a batch of `FIXED` links (strong) and the efficiency with 8 links a device
    (weak)."""
    strong = {str(n): step_s(parts, 1, FIXED, link, faster) / step_s(parts, n, FIXED, link, faster) for n in DEVICES}
    weak = {str(n): step_s(parts, 1, 8, link, faster) / step_s(parts, n, 8 * n, link, faster) for n in DEVICES}
    return {"strong_speedup": strong, "weak_efficiency": weak}


def on_paper(parts: dict[str, Any]) -> dict[str, Any]:
    """Returns strong and weak scaling of the measured fields, and the hours that a thousand scenes take, one a device."""
    found = {
        field: {
            speed: {link: scaling(own, link, faster) for link in LINKS}
            | {"limit": FIXED * own["spectrum_s"] / own["shared_s"] + 1}
            for speed, faster in FASTER.items()
        }
        for field, own in parts.items()
        if own["shared_s"] > 0
    }
    hours = {str(n): SCENES * SCENE_S / n / 3600 for n in DEVICES}
    return found | {"thousand_scenes_hours": hours}
