# Three targets: `actor` and `gateway`, without torch, and `learner`, with torch. The configuration of pip decides where
# packages come from; deploy/requirements has their hashes (`make lock`).
#
#   docker build --target actor --tag daedalus-actor .
#   docker build --target gateway --tag daedalus-gateway .
#   docker build --target learner --tag daedalus-learner .
ARG BASE=python:3.11.14-slim-bookworm@sha256:65a93d69fa75478d554f4ad27c85c1e69fa184956261b4301ebaf6dbb0a3543d

# A virtual environment without pip: the images hold only what the processes need.
FROM ${BASE} AS build
# The label finds the images that a build leaves behind: docker image prune --filter label=daedalus=build
LABEL daedalus=build
WORKDIR /source
RUN python3 -m venv --without-pip /opt/daedalus && python3 -m venv /opt/build
COPY constraints.txt .
COPY deploy/requirements deploy/requirements
RUN /opt/build/bin/pip install --no-cache-dir --require-hashes -r deploy/requirements/build.txt

FROM ${BASE} AS run
# A new volume mounted at /runs gets the owner of this folder.
RUN useradd --uid 1000 --create-home daedalus && install --directory --owner=daedalus --group=daedalus /runs
ENV PATH=/opt/daedalus/bin:$PATH
# A number, so that Kubernetes can check that the user is not root.
USER 1000:1000
WORKDIR /home/daedalus
ENTRYPOINT ["daedalus"]


FROM build AS build-actor
RUN python3 -m pip --python /opt/daedalus/bin/python install --no-cache-dir --require-hashes \
        -r deploy/requirements/actor.txt
# Extras for the environments that actors play; others are envpool, atari and video, which have no hashes.
ARG EXTRAS=box2d,monitoring
COPY . .
RUN /opt/build/bin/pip wheel --no-deps --no-build-isolation --wheel-dir /wheels . \
    && python3 -m pip --python /opt/daedalus/bin/python install --no-cache-dir -c constraints.txt \
        "$(echo /wheels/*.whl)[${EXTRAS}]" \
    && find /opt/daedalus -type d '(' -name tests -o -name test ')' -prune -exec rm -r {} +

FROM run AS actor
COPY --from=build-actor /opt/daedalus /opt/daedalus
# An actor uses one core. Thread pools of its libraries would take time on the cores of other processes.
ENV OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1


# A gateway plays, too, for the camera of its page: it is an actor with a web server.
FROM build-actor AS build-gateway
RUN python3 -m pip --python /opt/daedalus/bin/python install --no-cache-dir --require-hashes \
        -r deploy/requirements/gateway.txt \
    && python3 -m pip --python /opt/daedalus/bin/python install --no-cache-dir -c constraints.txt \
        "$(echo /wheels/*.whl)[gateway]"

FROM run AS gateway
COPY --from=build-gateway /opt/daedalus /opt/daedalus


FROM build AS build-learner
# torch has no hash: an index has the CPU build or one of the CUDA builds under this version. With the exact version
# before the rest: on some indexes a range would select the CUDA build.
RUN python3 -m pip --python /opt/daedalus/bin/python install --no-cache-dir --require-hashes \
        -r deploy/requirements/learner.txt \
    && python3 -m pip --python /opt/daedalus/bin/python install --no-cache-dir -c constraints.txt torch==2.13.0
# Extras for the environments that the learner makes once, to choose settings by their spaces.
ARG EXTRAS=box2d
COPY . .
RUN /opt/build/bin/pip wheel --no-deps --no-build-isolation --wheel-dir /wheels . \
    && python3 -m pip --python /opt/daedalus/bin/python install --no-cache-dir -c constraints.txt \
        "$(echo /wheels/*.whl)[learner,plot,certs,monitoring,gateway,${EXTRAS}]" \
    && find /opt/daedalus -type d '(' -name tests -o -name test ')' -prune -exec rm -r {} +

FROM run AS learner
COPY --from=build-learner /opt/daedalus /opt/daedalus
