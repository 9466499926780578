"""Cross-validation on logs."""

from affordlib.evaluation.cross_validate import cross_validate
