# SPDX-License-Identifier: Apache-2.0
"""What a machine is: schema, catalogue, robot, bodies, joints and members."""
