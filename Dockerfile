# The commands on a CPU: docker build -t pegasus_jax . && docker run -v "$PWD:/data" pegasus_jax pegasus-train task=cartpole
FROM python:3.13 AS build
COPY . /source
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheels /source

FROM python:3.13-slim
# OpenGL without a display, for the films of pegasus-play.
RUN apt-get update && apt-get install -y --no-install-recommends libegl1 libopengl0 libgl1-mesa-dri && rm -rf /var/lib/apt/lists/*
COPY --from=build /wheels /wheels
RUN pip install --no-cache-dir /wheels/*.whl
WORKDIR /data
CMD ["pegasus-train", "--help"]
