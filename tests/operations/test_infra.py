"""What infra/ sets up fits together: names, ports, options, secrets; tools check what they can."""

import re
import shutil
import ssl
import subprocess
import tomllib
from pathlib import Path

import dask
import distributed  # noqa: F401  its settings are then among Dask's
import pytest
import typer
import yaml

from flows.cli.app import app
from flows.orchestration.private_cluster import write_certificate

INFRA = Path(__file__).parents[2] / "infra"
KUSTOMIZATION = INFRA / "kubernetes" / "kustomization.yaml"
COMPOSE = yaml.safe_load((INFRA / "compose" / "compose.yaml").read_text())
SERVICES = COMPOSE["services"]


def options_of_serve():
    commands = typer.main.get_command(app)
    command = commands.get_command(typer.Context(commands), "serve")
    return {option for parameter in command.params for option in parameter.opts}


def test_the_image_installs_what_is_tested_together_and_checks_every_file():
    root = INFRA.parent
    tested = {
        name.lower().replace("_", "-"): version
        for name, version in re.findall(
            r"^([\w.-]+)==(\S+)", (root / "constraints.txt").read_text(), re.M
        )
    }
    image = (INFRA / "container" / "requirements.txt").read_text()
    entries = re.findall(r"^([\w.-]+)==([^ ]+)(.*?)(?=^[\w.-]+==|\Z)", image, re.M | re.S)
    assert all("--hash=sha256:" in rest for _, _, rest in entries)
    pinned = {name: version for name, version, _ in entries}
    assert {name: tested[name] for name in pinned if name in tested} == {
        name: version for name, version in pinned.items() if name in tested
    }
    wanted = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    extras = wanted["optional-dependencies"]
    for each in (*wanted["dependencies"], *extras["s3"], *extras["detectors"], *extras["tracing"]):
        assert re.split(r"[^\w.-]", each)[0] in pinned


def test_compose_opens_its_ports_to_this_machine_alone_and_holds_no_secret():
    ports = [port for service in SERVICES.values() for port in service.get("ports", ())]
    assert ports
    assert all(port.startswith("127.0.0.1:") for port in ports)
    given = [pair for each in SERVICES.values() for pair in each.get("environment", {}).items()]
    secret = [value for name, value in given if re.search("PASSWORD|SECRET|TOKEN", name)]
    assert len(secret) >= 5
    assert all(re.fullmatch(r"\$\{\w+:\?\}", value) for value in secret), secret


LOGINS = {
    "prefect": "PREFECT_SERVER_API_AUTH_STRING",
    "serve": "WORLDPOSE_REVIEW_TOKEN",
    "grafana": "GF_SECURITY_ADMIN_PASSWORD",
}
"""Services of compose that people reach, and what each asks for its login in."""


def test_compose_publishes_only_what_asks_for_a_login_and_gives_tokens_to_serve_alone():
    for name, service in SERVICES.items():
        is_published = "ports" in service
        assert is_published == (name in LOGINS), name
        if is_published:
            assert LOGINS[name] in service["environment"]
        elif name != "bucket":
            assert service["networks"] == ["inside"], name
    assert COMPOSE["networks"]["inside"] == {"internal": True}
    assert SERVICES["serve"]["environment"]["WORLDPOSE_METRICS_TOKEN"]
    login = SERVICES["prefect"]["environment"]["PREFECT_SERVER_API_AUTH_STRING"]
    assert SERVICES["serve"]["environment"]["PREFECT_API_AUTH_STRING"] == login
    guarded = ["python", "-m", "flows.orchestration.prefect_server"]
    assert SERVICES["prefect"]["entrypoint"][:3] == guarded
    for name, service in SERVICES.items():
        given = set(service.get("environment", {}))
        held = {each for each in given if re.search("REVIEW|METRICS_TOKEN|ALERT", each)}
        assert held == set() or name == "serve", name
    assert "AWS_SECRET_ACCESS_KEY" not in SERVICES["prefect"]["environment"]
    assert "AWS_SECRET_ACCESS_KEY" not in SERVICES["dask-scheduler"]["environment"]


def dask_parts():
    """Commands, environment and secrets of what takes part in Dask, by set-up and name."""
    for name in ("dask-scheduler", "dask-worker", "dask-worker-gpu", "serve"):
        service = SERVICES[name]
        command = service.get("entrypoint") or service["command"]
        files = {f"/run/secrets/{secret}" for secret in service["secrets"]}
        yield f"compose {name}", command, service["environment"], files
    kustomization = yaml.safe_load(KUSTOMIZATION.read_text())
    (paths,) = [
        dict(each.split("=", 1) for each in generated["literals"])
        for generated in kustomization["configMapGenerator"]
        if generated["name"] == "dask-tls-paths"
    ]
    for manifest in manifests():
        kind, name = named(manifest)
        if kind == "Deployment" and name != "prefect":
            (container,) = manifest["spec"]["template"]["spec"]["containers"]
            command = container.get("command") or container["args"]
            assert {"configMapRef": {"name": "dask-tls-paths"}} in container["envFrom"]
            mounted = {mount["mountPath"] for mount in container["volumeMounts"]}
            files = {"/tls/certificate.pem", "/tls/key.pem"} if "/tls" in mounted else set()
            yield f"kubernetes {name}", command, paths, files


def test_dask_takes_no_connection_without_its_certificate():
    parts = list(dask_parts())
    assert len(parts) == 8
    for name, command, environment, files in parts:
        text = " ".join(command)
        assert "tcp://" not in text, name
        assert "tls://" in text or "--protocol tls" in text, name
        if "worker" in name:
            assert "tasks.preload" in text, name
        prefix = "DASK_DISTRIBUTED__COMM__"
        assert environment[f"{prefix}REQUIRE_ENCRYPTION"] == "true", name
        given = {v for k, v in environment.items() if k.startswith(f"{prefix}TLS__")}
        assert given == files, name
        # Names that Dask knows.
        for key in (key for key in environment if key.startswith(prefix)):
            place = key.removeprefix("DASK_").lower().replace("__", ".")
            assert dask.config.get(place.replace("_", "-"), "unknown") != "unknown", key


def test_pods_of_kubernetes_are_reached_by_those_alone_that_a_policy_names():
    policies = [each["spec"] for each in manifests() if each["kind"] == "NetworkPolicy"]
    assert {"podSelector": {}, "policyTypes": ["Ingress"]} in policies
    for manifest in manifests():
        kind, name = named(manifest)
        if kind != "Deployment":
            continue
        spec = manifest["spec"]["template"]["spec"]
        (container,) = spec["containers"]
        assert not spec["automountServiceAccountToken"], name
        assert container["securityContext"]["capabilities"] == {"drop": ["ALL"]}, name
        assert not container["securityContext"]["allowPrivilegeEscalation"], name
        (policy,) = [each for each in policies if name in str(each["podSelector"])]
        for rule in policy["ingress"]:
            assert rule["from"], name
            ports = {port["name"] for port in container.get("ports", ())}
            assert {port["port"] for port in rule.get("ports", ())} <= ports, name
    text = str([each for each in manifests() if named(each) == ("Deployment", "prefect")])
    assert "flows.orchestration.prefect_server" in text
    assert "prefect-login" in text
    # The guard answers a probe that names the server.
    assert text.count("'name': 'Host', 'value': 'prefect'") == 2


def test_a_certificate_is_for_this_user_alone_and_made_anew(tmp_path):
    folder = tmp_path / "tls"
    write_certificate(folder)
    key = (folder / "key.pem").read_text()
    write_certificate(folder)
    assert folder.stat().st_mode & 0o777 == 0o700
    for name in ("certificate.pem", "key.pem"):
        assert (folder / name).stat().st_mode & 0o777 == 0o600
    assert (folder / "key.pem").read_text() != key
    context = ssl.create_default_context(cafile=folder / "certificate.pem")
    context.load_cert_chain(folder / "certificate.pem", folder / "key.pem")


@pytest.mark.parametrize("setup", ["compose", "kubernetes"])
def test_serve_is_given_options_that_it_has(setup):
    if setup == "compose":
        arguments = SERVICES["serve"]["command"]
    else:
        (serve,) = [each for each in manifests() if named(each) == ("Deployment", "serve")]
        (container,) = serve["spec"]["template"]["spec"]["containers"]
        arguments = container["args"]
    assert arguments[0] == "serve"
    given = {argument.partition("=")[0] for argument in arguments[1:]}
    assert given <= options_of_serve()
    # Workers see matches at the path at which they arrive.
    assert "--inbox=/inbox" in arguments


def manifests():
    files = yaml.safe_load(KUSTOMIZATION.read_text())["resources"]
    return [
        document
        for file in files
        for document in yaml.safe_load_all((INFRA / "kubernetes" / file).read_text())
    ]


def named(manifest):
    return manifest["kind"], manifest["metadata"]["name"]


def test_kubernetes_manifests_refer_to_what_is_there():
    known = {named(each): each for each in manifests()}
    kustomization = KUSTOMIZATION.read_text()
    secrets = set(re.findall(r"--from-literal=([\w-]+)=", kustomization))
    for (kind, name), each in known.items():
        if kind == "Service":
            pod = known["Deployment", each["spec"]["selector"]["app"]]["spec"]["template"]
            container_ports = {
                port["name"]
                for container in pod["spec"]["containers"]
                for port in container["ports"]
            }
            assert {port["targetPort"] for port in each["spec"]["ports"]} <= container_ports
        if kind != "Deployment":
            continue
        spec = each["spec"]["template"]["spec"]
        labels = each["spec"]["template"]["metadata"]["labels"]
        assert each["spec"]["selector"]["matchLabels"] == labels
        assert spec["securityContext"]["runAsNonRoot"]
        volumes = {volume["name"]: volume for volume in spec.get("volumes", ())}
        for volume in volumes.values():
            claim = volume.get("persistentVolumeClaim", {}).get("claimName")
            assert claim is None or ("PersistentVolumeClaim", claim) in known
        for container in spec["containers"]:
            assert {mount["name"] for mount in container.get("volumeMounts", ())} <= set(volumes)
            assert "memory" in container["resources"]["limits"]
            text = str(container)
            for key in re.findall(r"'key': '([\w-]+)'", text):
                assert key in secrets, name
            for host in re.findall(r"(?:http|tcp)://([a-z-]+):", text):
                assert ("Service", host) in known, host


def needs(tool):
    return pytest.mark.skipif(shutil.which(tool) is None, reason=f"{tool} is not installed")


@needs("kubectl")
def test_kubectl_builds_the_kubernetes_set_up():
    built = subprocess.run(
        ["kubectl", "kustomize", INFRA / "kubernetes"], capture_output=True, text=True, check=True
    )
    documents = list(yaml.safe_load_all(built.stdout))
    assert {each["metadata"]["namespace"] for each in documents} == {"worldpose"}
    assert "image: worldpose\n" not in built.stdout
    assert len(documents) == len(manifests()) + 2  # the settings that are made of literals


@needs("docker-compose")
def test_compose_takes_its_set_up_and_refuses_one_without_secrets():
    tool = shutil.which("docker-compose")
    command = [tool, "-f", INFRA / "compose" / "compose.yaml", "--profile", "gpu"]
    secrets = ["WORLDPOSE_REVIEW_TOKEN", "POSTGRES_PASSWORD", "S3_SECRET", "GRAFANA_PASSWORD"]
    secrets += ["PREFECT_PASSWORD", "WORLDPOSE_METRICS_TOKEN"]
    given = {"PATH": "/bin", **dict.fromkeys(secrets, "secret")}
    built = subprocess.run([*command, "config"], capture_output=True, text=True, env=given)
    assert built.returncode == 0, built.stderr
    assert yaml.safe_load(built.stdout)["services"].keys() == SERVICES.keys()
    for missing in secrets:
        fewer = {name: value for name, value in given.items() if name != missing}
        refused = subprocess.run([*command, "config"], capture_output=True, text=True, env=fewer)
        # As a Python package it ends with 0 whatever it finds.
        assert (refused.stdout, missing in refused.stderr) == ("", True), refused


@needs("promtool")
def test_promtool_takes_scrapes_and_rules():
    # Only the syntax of scrapes: the files of their secrets are the deployment's.
    folder = INFRA / "prometheus"
    for command in (
        ["check", "config", "--syntax-only", folder / "prometheus.yml"],
        ["check", "rules", folder / "alerts.yml"],
        ["test", "rules", folder / "alerts_test.yml"],
    ):
        subprocess.run(["promtool", *command], check=True)


def test_the_batch_script_is_a_shell_script_that_asks_for_its_arguments():
    script = INFRA / "slurm" / "dask.sbatch"
    subprocess.run(["bash", "-n", script], check=True)
    bare = subprocess.run(["bash", script], capture_output=True, text=True, env={"PATH": "/bin"})
    assert bare.returncode != 0
    assert "a match folder" in bare.stderr
