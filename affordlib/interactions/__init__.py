"""The robot's experience: collecting it, storing it, and cutting it into training batches."""

from affordlib.interactions.dataset import InteractionTensors, Scaler, Split, split_interactions
from affordlib.interactions.log import Log, PushLog
from affordlib.interactions.store import CorruptedDataError, open_interactions
