# mp4ds as a command:
#   docker build --tag mp4ds .
#   docker run --rm --user "$(id -u):$(id -g)" --volume "$PWD:/data" mp4ds pack drive.mcap -o drive
# PyAV's wheel brings an ffmpeg with x264 and x265 (GPL): see docs/faq.md before you publish an image.
FROM python:3.13-slim AS build
# hadolint ignore=DL3008
RUN apt-get update \
 && apt-get install --yes --no-install-recommends gcc libc6-dev \
 && rm -rf /var/lib/apt/lists/*
COPY . /source
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheels /source

FROM python:3.13-slim
COPY --from=build /wheels /wheels
RUN pip install --no-cache-dir "$(echo /wheels/mp4ds-*.whl)[cluster,remote,vmaf]" \
 && useradd --create-home --uid 1000 mp4ds
USER 1000
WORKDIR /data
ENTRYPOINT ["mp4ds"]
CMD ["--help"]
