"""A log of one's own: off-centre pushes of one object, models fitted to them, and plans."""

from affordlib.logs.cross_validate import cross_validate, summary
from affordlib.logs.fit import FittedModel, fit, load_model, save_model
from affordlib.logs.log import Log, LoggedPushes, Pushes, planar
from affordlib.logs.planning import PushedObject, PushPlanner
