# Two targets: `actor`, without torch, and `learner`, with it. Which registry packages come from is for pip's own
# configuration to say.
#
#   docker build --target actor --tag daedalus-actor .
#   docker build --target learner --tag daedalus-learner .
ARG BASE=python:3.11-slim

# A virtual environment without pip: only what runs reaches the images.
FROM ${BASE} AS build
# What a build leaves behind is found by it: docker image prune --filter label=daedalus=build
LABEL daedalus=build
WORKDIR /source
RUN python3 -m venv --without-pip /opt/daedalus
COPY constraints.txt .

FROM ${BASE} AS run
# A volume that is mounted at /runs for the first time takes its owner from here.
RUN useradd --uid 1000 --create-home daedalus && install --directory --owner=daedalus --group=daedalus /runs
ENV PATH=/opt/daedalus/bin:$PATH
# By number, so that Kubernetes can see that it is not root.
USER 1000:1000
WORKDIR /home/daedalus
ENTRYPOINT ["daedalus"]


FROM build AS build-actor
# What actors play: also envpool, atari, video.
ARG EXTRAS=box2d,monitoring
COPY . .
RUN python3 -m pip --python /opt/daedalus/bin/python install --no-cache-dir -c constraints.txt ".[${EXTRAS}]" \
    && find /opt/daedalus -type d '(' -name tests -o -name test ')' -prune -exec rm -r {} +

FROM run AS actor
COPY --from=build-actor /opt/daedalus /opt/daedalus
# An actor has one core at most: pools of threads in its libraries would only spin on everybody else's.
ENV OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1


FROM build AS build-learner
# torch first and by its exact version: a range would pull the CUDA build on some indexes.
RUN python3 -m pip --python /opt/daedalus/bin/python install --no-cache-dir -c constraints.txt torch==2.13.0
COPY . .
RUN python3 -m pip --python /opt/daedalus/bin/python install --no-cache-dir -c constraints.txt ".[learner,plot,certs,monitoring]" \
    && find /opt/daedalus -type d '(' -name tests -o -name test ')' -prune -exec rm -r {} +

FROM run AS learner
COPY --from=build-learner /opt/daedalus /opt/daedalus
