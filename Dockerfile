# wbgs-jax on an NVIDIA GPU; JAX brings CUDA along, the host needs its driver and the NVIDIA container toolkit alone.
#
#   docker build -t wbgs-jax .
#   docker run --rm --gpus all -v "$PWD/runs:/work/runs" wbgs-jax train --scene 1
#
# Without a GPU: docker build --build-arg EXTRAS= ... and no --gpus.
FROM python:3.12-slim
ARG EXTRAS=[cuda,viewer]
WORKDIR /opt/wbgs-jax
COPY pyproject.toml README.md LICENSE ./
COPY wbgs_jax wbgs_jax
RUN pip install --no-cache-dir ".${EXTRAS}"
WORKDIR /work
ENTRYPOINT ["wbgs-jax"]
CMD ["--help"]
