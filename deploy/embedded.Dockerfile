# The embedded Placewise: one process, data under /data.
FROM python:3.12-slim

# Another build of PyTorch; empty takes CUDA's from the ordinary index.
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu

RUN apt-get update \
    && apt-get install --yes --no-install-recommends make \
    && rm -rf /var/lib/apt/lists/* \
    && useradd --uid 10001 --create-home placewise \
    && mkdir /data && chown 10001:10001 /data

WORKDIR /app
COPY pyproject.toml requirements.lock Makefile README.md LICENSE ./
COPY services services
COPY shared shared
RUN make setup TORCH_INDEX="${TORCH_INDEX}"

USER 10001:10001
ENV PATH=/app/.venv/bin:$PATH PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1
VOLUME /data
EXPOSE 8000
CMD ["placewise", "serve"]
