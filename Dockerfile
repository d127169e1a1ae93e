# gdtool on a CPU, as an unprivileged user.
#
#   docker build -t gdtool .
#   docker run --rm -v "$PWD:/work" --user "$(id -u):$(id -g)" gdtool sample-views cat.png
#
# The image holds pymeshlab, which is under GPL-3.0: see NOTICE before you pass the image on.
FROM python:3.12-slim-bookworm

# libgl1 and libgomp1: what pymeshlab and torch are linked with. glibc 2.36 is here; pymeshlab needs 2.35.
RUN apt-get update \
    && apt-get install --yes --no-install-recommends libgl1 libgomp1 \
    && rm -rf /var/lib/apt/lists/*

COPY . /src
RUN pip install --no-cache-dir --constraint /src/constraints.txt torch==2.13.0 --extra-index-url https://download.pytorch.org/whl/cpu \
    && pip install --no-cache-dir --constraint /src/constraints.txt "/src[codecs]" \
    && rm -rf /src

RUN useradd --create-home gdtool
USER gdtool
WORKDIR /work
ENTRYPOINT ["gdtool"]
