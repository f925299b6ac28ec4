"""A stand-in for the Hugging Face Hub: the part of its HTTP interface that huggingface_hub uses, on loopback."""

import base64
import hashlib
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

TOKEN = "hf_standin"
_LARGE = (".onnx", ".safetensors", ".mp4", ".gif")  # stored as large files, as by the Hub's .gitattributes
_MISSING = object()


@dataclass
class Repository:
    """One repository: its commits, oldest first, and names of commits."""

    private: bool = False
    commits: list[tuple[str, dict[str, bytes]]] = field(default_factory=list)
    names: dict[str, str] = field(default_factory=dict)  # tags

    def commit(self, files: dict[str, bytes]) -> str:
        sha = hashlib.sha1(repr((len(self.commits), sorted(files.items()))).encode()).hexdigest()
        self.commits.append((sha, files))
        return sha

    def files(self, revision: str) -> tuple[str, dict[str, bytes]] | None:
        if revision == "main":
            return self.commits[-1]
        revision = self.names.get(revision, revision)
        return next(((sha, files) for sha, files in self.commits if sha == revision), None)


class HubServer:
    """The stand-in: repositories, and what was asked."""

    def __init__(self) -> None:
        self.repositories: dict[str, Repository] = {}
        self.large: dict[str, bytes] = {}  # by their SHA-256
        self.requests: list[str] = []  # method and path
        self.sizes: dict[str, Any] = {}  # sizes that the server claims, by the name of a file
        self.status = 0  # of all answers, unless it is 0
        self.answers = threading.Event()  # cleared: requests are read and not answered
        self.answers.set()
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), _Handler)
        self._server.hub = self  # type: ignore[attr-defined]
        self.address = f"http://127.0.0.1:{self._server.server_address[1]}"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def add(self, name: str, files: dict[str, bytes]) -> Repository:
        repository = self.repositories.setdefault(name, Repository())
        repository.commit(files)
        return repository

    def files(self, name: str, revision: str = "main") -> dict[str, bytes]:
        found = self.repositories[name].files(revision)
        assert found is not None
        return found[1]

    def close(self) -> None:
        self.answers.set()
        self._server.shutdown()
        self._server.server_close()


@contextmanager
def serving() -> Iterator[HubServer]:
    server = HubServer()
    try:
        yield server
    finally:
        server.close()


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    @property
    def hub(self) -> HubServer:
        return self.server.hub  # type: ignore[attr-defined]

    def log_message(self, format: str, *arguments: Any) -> None:
        pass

    def do_HEAD(self) -> None:
        self._answer()

    def do_GET(self) -> None:
        self._answer()

    def do_POST(self) -> None:
        self._answer()

    def do_PUT(self) -> None:
        self._answer()

    def _answer(self) -> None:
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        path = unquote(urlsplit(self.path).path)
        self.hub.requests.append(f"{self.command} {path}")
        self.hub.answers.wait()
        if self.hub.status:
            return self._error(self.hub.status, "", "the stand-in was told to fail")
        parts = path.strip("/").split("/")
        match self.command, parts:
            case "POST", ["api", "validate-yaml"]:
                self._json({"errors": [], "warnings": []})
            case "POST", ["api", "repos", "create"]:
                self._create(json.loads(body))
            case "GET", ["api", "models", user, name]:
                self._info(f"{user}/{name}", "main")
            case "GET", ["api", "models", user, name, "revision", *revision]:
                self._info(f"{user}/{name}", "/".join(revision))
            case "POST", ["api", "models", user, name, "preupload", _]:
                self._preupload(json.loads(body))
            case "POST", [user, git, "info", "lfs", "objects", "batch"] if git.endswith(".git"):
                self._batch(json.loads(body))
            case "PUT", ["large", oid]:
                assert hashlib.sha256(body).hexdigest() == oid
                self.hub.large[oid] = body
                self._json({})
            case "POST", ["api", "models", user, name, "commit", _]:
                self._commit(f"{user}/{name}", body)
            case "HEAD" | "GET", [user, name, "resolve", revision, *file]:
                self._resolve(f"{user}/{name}", revision, "/".join(file))
            case _:
                self._error(404, "", f"the stand-in has no {path}")

    @property
    def _logged_in(self) -> bool:
        return self.headers.get("Authorization") == f"Bearer {TOKEN}"

    def _create(self, asked: dict[str, Any]) -> None:
        if not self._logged_in:
            return self._error(401, "", "Invalid username or password.")
        name = f"{asked.get('organization') or 'ada'}/{asked['name']}"
        if asked.get("organization") not in (None, "ada"):
            return self._error(403, "", "You don't have the rights to create a model under this namespace")
        if name in self.hub.repositories:
            return self._error(409, "", "You already created this model repo", url=f"{self.hub.address}/{name}")
        repository = self.hub.add(name, {".gitattributes": b"*.onnx filter=lfs\n"})
        repository.private = asked.get("visibility") == "private" or bool(asked.get("private"))
        self._json({"url": f"{self.hub.address}/{name}", "name": name, "id": "1"})

    def _repository(self, name: str) -> Repository | None:
        repository = self.hub.repositories.get(name)
        if repository is None or (repository.private and not self._logged_in):
            self._error(404 if self._logged_in else 401, "RepoNotFound", "Repository not found")
            return None
        return repository

    def _info(self, name: str, revision: str) -> None:
        repository = self._repository(name)
        if repository is None:
            return
        found = repository.files(revision)
        if found is None:
            return self._error(404, "RevisionNotFound", f"Invalid rev id: {revision}")
        sha, files = found
        siblings: list[dict[str, Any]] = [{"rfilename": file} for file in files]
        if "blobs" in parse_qs(urlsplit(self.path).query):
            siblings = [{"rfilename": file, "size": self.hub.sizes.get(file, len(files[file]))} for file in files]
        self._json(
            {"id": name, "modelId": name, "sha": sha, "private": repository.private, "siblings": siblings, "tags": []}
        )

    def _preupload(self, asked: dict[str, Any]) -> None:
        files = [
            {
                "path": each["path"],
                "uploadMode": "lfs" if each["path"].endswith(_LARGE) else "regular",
                "shouldIgnore": False,
            }
            for each in asked["files"]
        ]
        self._json({"files": files})

    def _batch(self, asked: dict[str, Any]) -> None:
        objects = [
            {**each, "actions": {"upload": {"href": f"{self.hub.address}/large/{each['oid']}"}}}
            for each in asked["objects"]
        ]
        self._json({"transfer": "basic", "objects": objects})

    def _commit(self, name: str, body: bytes) -> None:
        repository = self._repository(name)
        if repository is None:
            return
        if not self._logged_in:
            return self._error(401, "", "Invalid username or password.")
        files = dict(repository.commits[-1][1])
        for line in body.splitlines():
            each = json.loads(line)
            match each["key"], each["value"]:
                case "file", value:
                    files[value["path"]] = base64.b64decode(value["content"])
                case "lfsFile", value:
                    files[value["path"]] = self.hub.large[value["oid"]]
                case "deletedFile", value:
                    del files[value["path"]]
        sha = repository.commit(files)
        address = f"{self.hub.address}/{name}/commit/{sha}"
        self._json({"commitUrl": address, "commitOid": sha, "pullRequestUrl": None, "success": True})

    def _resolve(self, name: str, revision: str, file: str) -> None:
        repository = self._repository(name)
        if repository is None:
            return
        found = repository.files(revision)
        if found is None:
            return self._error(404, "RevisionNotFound", "Invalid rev id")
        sha, files = found
        if file not in files:
            return self._error(404, "EntryNotFound", "Entry not found")
        data = files[file]
        etag = hashlib.sha256(data).hexdigest()
        self._send(200, data, {"ETag": f'"{etag}"', "X-Repo-Commit": sha, "Accept-Ranges": "bytes"})

    def _json(self, content: Any) -> None:
        self._send(200, json.dumps(content).encode(), {"Content-Type": "application/json"})

    def _error(self, status: int, code: str, message: str, **fields: Any) -> None:
        headers = {"X-Error-Message": message, **({"X-Error-Code": code} if code else {})}
        self._send(status, json.dumps({"error": message, **fields}).encode(), headers)

    def _send(self, status: int, data: bytes, headers: dict[str, str]) -> None:
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)
