# A stock ROS 2 Jazzy with pea: docker build -t pea . && docker run --rm pea make demo
FROM ros:jazzy-ros-base
RUN apt-get update && apt-get install -y --no-install-recommends \
      make python3-venv python3-pip && rm -rf /var/lib/apt/lists/*
WORKDIR /pea
COPY . .
SHELL ["/bin/bash", "-c"]
# the sourced ROS is used: the ros-* wheels and numpy of the lock files are left out
RUN . /opt/ros/jazzy/setup.bash && make setup
ENTRYPOINT ["/bin/bash", "-c", ". /opt/ros/jazzy/setup.bash && exec \"$@\"", "--"]
CMD ["./pea", "run", "fig9_hysteresis_10hz", "--mode", "distributed", "--duration", "0.5"]
