# lidargrit on the CPU: docker build -t lidargrit . && docker run --rm -v "$PWD:/work" lidargrit --help
FROM python:3.11-slim

# The CPU build of torch comes from its makers' index, since the one of PyPI brings gigabytes for GPUs.
WORKDIR /source
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY src src
RUN pip install --no-cache-dir --extra-index-url https://download.pytorch.org/whl/cpu -c constraints.txt ".[argoverse,las]" \
    && rm -rf /source

RUN useradd --create-home --uid 1000 lidargrit && mkdir /work && chown lidargrit /work
USER lidargrit
WORKDIR /work
# So that another user's number, as docker run --user gives it, may write there too.
ENV HOME=/tmp LIDARGRIT_CACHE=/tmp/lidargrit
ENTRYPOINT ["lidargrit"]
