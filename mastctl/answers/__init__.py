"""The daemon's answers, key by key: the service makes these records, the web side describes them, and the
event stream, recordings and clients have them.

They are plain dictionaries whose keys a type checker knows. Each key is there unless it is ``NotRequired``.
Others may come later.
"""

from mastctl.answers.keeping import *  # noqa: F403
from mastctl.answers.motion import *  # noqa: F403
from mastctl.answers.status import *  # noqa: F403
