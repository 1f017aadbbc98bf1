"""Makes a metric for the error of a predicted measurement, such as a contact force or an image of a second camera."""

import numpy as np

from sts_jax.dataset import Measurement, Pairs
from sts_jax.evaluation.predictions import Predicted, in_unit
from sts_jax.evaluation.records import Judged, Metric, Statistic, mean


def measurement_error(measurement: Measurement) -> Metric:
    """Make the metric for the error of one measurement in the predicted last frame.

    A measurement is a quantity of a trajectory's first and last frames, in addition to the visual image, the tactile
    image and the pose. Examples are the contact force and an image of a second camera.

    Args:
        measurement: The specification of the measurement.

    Returns:
        The metric `NAME_error`. It is a mean over the held-out trajectories whose last frame was measured. For a
        vector, the error of a trajectory is the length of the difference vector, in the unit of the measurement. For an
        image, it is the mean absolute difference over all pixels and channels.
    """
    name = f"{measurement.name}_error"

    def errors(predicted: Predicted, test: Pairs) -> np.ndarray | None:
        values = (predicted.measurements or {}).get(measurement.name)
        if values is None or measurement.name not in test.measurements:
            return None
        difference = in_unit(values) - in_unit(test.measurements[measurement.name][:, 1])
        if measurement.is_image:
            return np.abs(difference).mean((1, 2, 3))
        return np.linalg.norm(difference, axis=1)

    def statistic(judged: Judged) -> Statistic | None:
        values = (judged.scores.further or {}).get(name)
        if values is None:
            return None
        known = np.isfinite(values)
        return lambda weight: mean(values[known], weight[known])

    return Metric(name, errors, unit=measurement.unit, statistic=statistic, compared="lower")
