"""Colours of procedural objects, chosen in sRGB and returned in linear light, as arrays (3,) in [0, 1]."""

import numpy as np

Number = float | int
Color = np.ndarray
PLAIN = 0.7  # sRGB grey of a mesh without colours


def linear(srgb: np.ndarray) -> np.ndarray:
    """Convert sRGB values in [0, 1] to linear light (IEC 61966-2-1)."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def hsv(hue: Number, saturation: Number, value: Number) -> Color:
    """Colour of a hue, a saturation and a value in sRGB, each in [0, 1]."""
    wheel = np.clip(np.abs((hue * 6 + np.array([0.0, 4.0, 2.0])) % 6 - 3) - 1, 0, 1)
    return linear(value * (1 - saturation * (1 - wheel)))


def grey(value: Number) -> Color:
    """Grey of an sRGB value in [0, 1]."""
    return linear(np.full(3, float(value)))


def vivid(rng: np.random.Generator) -> Color:
    """Draw a saturated and bright colour of any hue."""
    return hsv(rng.uniform(), rng.uniform(0.65, 0.95), rng.uniform(0.6, 0.95))


def pale(rng: np.random.Generator) -> Color:
    """Draw a bright, nearly white colour of any hue."""
    return hsv(rng.uniform(), rng.uniform(0.0, 0.25), rng.uniform(0.8, 0.97))


def dark(rng: np.random.Generator) -> Color:
    """Draw a dark, nearly black colour of any hue."""
    return hsv(rng.uniform(), rng.uniform(0.0, 0.25), rng.uniform(0.12, 0.24))


def steel(rng: np.random.Generator) -> Color:
    """Draw a bluish grey that resembles steel."""
    return hsv(0.58, rng.uniform(0.0, 0.1), rng.uniform(0.58, 0.8))


BLACK = grey(0.1)
WHITE = grey(0.96)
GLASS = linear(np.array([0.09, 0.13, 0.32]))
GLINT = linear(np.array([0.75, 0.85, 1.0]))  # a bright reflection on glass
