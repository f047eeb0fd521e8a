# devrf with everything but development tools.
#
#   docker build -t devrf .                              for the CPU
#   docker build -t devrf --build-arg TORCH=cu126 .      for NVIDIA GPUs: docker run --gpus all ...
#   docker run --rm -v "$PWD":/data devrf run scene.yaml
#
# TORCH names an index of PyTorch's wheels (cpu, cu126, cu128, ...); CUDA's libraries come with them, the driver is the host's.

ARG PYTHON=3.12
FROM python:${PYTHON}-slim AS build
WORKDIR /src
COPY . .
RUN python -m pip wheel --no-cache-dir --no-deps --wheel-dir /wheel .

FROM python:${PYTHON}-slim
ARG TORCH=cpu
COPY constraints.txt /tmp/constraints.txt
COPY --from=build /wheel /wheel
RUN python -m pip install --no-cache-dir --constraint /tmp/constraints.txt \
      --index-url "https://download.pytorch.org/whl/${TORCH}" --extra-index-url https://pypi.org/simple torch \
    && python -m pip install --no-cache-dir --constraint /tmp/constraints.txt "$(echo /wheel/*.whl)[export,viewer]" \
    && rm -r /wheel /tmp/constraints.txt
# Files belong to whoever runs the container: docker run --user "$(id -u):$(id -g)" ...
RUN mkdir --mode=1777 /cache /data
ENV HOME=/cache MPLCONFIGDIR=/cache/matplotlib
WORKDIR /data
ENTRYPOINT ["devrf-pipeline"]
CMD ["--help"]
