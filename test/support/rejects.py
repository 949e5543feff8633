# SPDX-License-Identifier: Apache-2.0
"""How a message is rejected."""

import pytest

from pkm_twin.errors import MessageError


def reject(call, *arguments):
    """The reason and the text of the error that a call raises."""
    with pytest.raises(MessageError) as caught:
        call(*arguments)
    return caught.value.reason, str(caught.value)
