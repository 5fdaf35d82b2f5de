# Palpate with CUDA and drawing without a screen. A GPU's driver comes from the host:
#   docker build -t palpate . && docker run --gpus all palpate doctor
FROM python:3.12-slim
# Warp's wheel brings CUDA's runtime and compiler; EGL is the driver's, Mesa's where there is none.
ENV NVIDIA_DRIVER_CAPABILITIES=compute,utility,graphics MUJOCO_GL=egl
RUN apt-get update \
 && apt-get install -y --no-install-recommends libegl1 libgl1 libosmesa6 \
 && rm -rf /var/lib/apt/lists/*
COPY . /palpate
RUN pip install --no-cache-dir '/palpate[all]'
ENTRYPOINT ["palpate"]
CMD ["doctor"]
