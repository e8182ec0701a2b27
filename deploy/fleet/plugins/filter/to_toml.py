"""A mapping as the text of a TOML file: `drivegate_configuration | drivegate.fleet.to_toml`."""

from ansible.errors import AnsibleFilterError
from ansible_collections.drivegate.fleet.plugins.module_utils.toml_text import to_toml

DOCUMENTATION = """
name: to_toml
short_description: A mapping as the text of a TOML file
description:
  - Keeps the order of the keys; values of a table come before the tables in it.
options:
  _input:
    description: The mapping.
    type: dict
    required: true
"""
EXAMPLES = """
- ansible.builtin.copy:
    content: "{{ drivegate_configuration | drivegate.fleet.to_toml }}"
    dest: /etc/drivegate/drivegate.toml
    mode: "0644"
"""
RETURN = """
_value:
  description: The text.
  type: str
"""


def filtered(mapping):
    try:
        return to_toml(mapping)
    except ValueError as error:
        raise AnsibleFilterError(str(error)) from error


class FilterModule:
    def filters(self):
        return {"to_toml": filtered}
