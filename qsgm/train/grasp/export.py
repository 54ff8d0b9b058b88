"""`qsgm fold-and-quantize` of the grasping task: a calibration set of demonstration frames."""

from pathlib import Path

from qsgm.files import check_replaceable
from qsgm.grasp.distractors import FILE as DISTRACTORS
from qsgm.grasp.task import grasp_task
from qsgm.manifest import WEIGHTS
from qsgm.progress import Progress
from qsgm.train.checkpoint import load_checkpoint
from qsgm.train.export import ExportOptions, export_bundle
from qsgm.train.export_report import ExportReport
from qsgm.train.grasp.calibration_set import CalibrationLessons, CalibrationSet
from qsgm.train.grasp.draw_distractors import SHEET_SEED, distractor_file


def fold_and_quantize(
    checkpoint_path: Path,
    calib_folder: Path,
    output_folder: Path,
    watch: Progress,
    options: ExportOptions = ExportOptions(),  # noqa: B008 (it is frozen)
) -> ExportReport:
    """Export a checkpoint as a bundle.

    Args:
        checkpoint_path: `sgm.pt`.
        calib_folder: a calibration set, see :mod:`qsgm.train.grasp.draw_calibration`.
        output_folder: absent, empty, or an earlier bundle.
        watch: told about progress.
        options: what the bundle is to hold.

    Raises:
        QsgmError: as :func:`qsgm.train.export.export_bundle`; or it is another task's checkpoint.
    """
    check_replaceable(output_folder, WEIGHTS)
    task = grasp_task(load_checkpoint(checkpoint_path).task, str(checkpoint_path))
    lessons = CalibrationLessons(CalibrationSet(calib_folder), task)
    things = {DISTRACTORS: distractor_file(SHEET_SEED)}
    return export_bundle(checkpoint_path, lessons, output_folder, things, watch, options)
