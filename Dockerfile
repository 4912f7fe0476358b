# pdhef as a container. The wheel comes from `make wheel`; then, from this folder:
#
#   docker build -t pdhef .
#   docker run --rm -v "$PWD:/work" --user "$(id -u):$(id -g)" pdhef run drive.mcap -o out
FROM python:3.11-slim

ENV PIP_NO_CACHE_DIR=1 PIP_ROOT_USER_ACTION=ignore PIP_DISABLE_PIP_VERSION_CHECK=1 PYTHONUNBUFFERED=1

COPY constraints.txt dist/*.whl /tmp/dist/
RUN pip install --constraint /tmp/dist/constraints.txt /tmp/dist/*.whl && rm -r /tmp/dist

# Compiles the filters, once, into the installation. On a processor of another kind they are compiled again at first use,
# into the cache of the user who runs them.
RUN pdhef compile

# Nobody in particular: --user makes outputs belong to whoever runs it, who then has no home of his own here.
RUN useradd --create-home --uid 1000 pdhef && mkdir -m 1777 /work
USER pdhef
WORKDIR /work
ENV MPLCONFIGDIR=/tmp
ENTRYPOINT ["pdhef"]
CMD ["--help"]
