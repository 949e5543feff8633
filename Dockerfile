# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
# ROS 2 with the package, built by colcon. docker run starts the demonstration.
FROM ros:jazzy AS dependencies
# rosdep installs mcap by pip, next to Ubuntu's Python packages.
ENV PIP_BREAK_SYSTEM_PACKAGES=1
WORKDIR /ws/src/pkm_twin
COPY package.xml .
# rosdep has no key for llvmlite. make needs venv.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3-llvmlite python3-pip python3-venv \
    && rosdep update \
    && rosdep install --from-paths . --ignore-src -y \
    && rm -rf /var/lib/apt/lists/*

FROM dependencies
COPY . .
WORKDIR /ws
RUN . "/opt/ros/$ROS_DISTRO/setup.sh" && colcon build
CMD ["bash", "-c", "source install/setup.bash && python3 -m pkm_twin.demo.run --bags src/pkm_twin/bags --out out"]
