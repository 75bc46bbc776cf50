# fmtorch on the CPU, with its kernels compiled for the processor that builds the image (any other compiles its own).
#   docker build -t fmtorch .
#   docker run --rm -v "$PWD":/work fmtorch match a.jpg b.jpg
FROM python:3.11-slim
ENV FMTORCH_CACHE=/var/cache/fmtorch PIP_NO_CACHE_DIR=1
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
COPY pyproject.toml README.md LICENSE constraints.txt /src/
COPY fmtorch /src/fmtorch
COPY conf /src/conf
COPY models /src/models
RUN pip install --index-url "$TORCH_INDEX" "$(grep '^torch==' /src/constraints.txt)" \
    && pip install -c /src/constraints.txt '/src[h5,colmap,report]' \
    && rm -rf /src \
    && fmtorch warm-up \
    && chmod -R a+rwX "$FMTORCH_CACHE"
WORKDIR /work
ENTRYPOINT ["fmtorch"]
