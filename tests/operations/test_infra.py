"""What infra/ sets up fits together: names, ports, options, secrets; tools check what they can."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest
import typer
import yaml

from flows.cli.serve import add_to

INFRA = Path(__file__).parents[2] / "infra"
KUSTOMIZATION = INFRA / "kubernetes" / "kustomization.yaml"
COMPOSE = yaml.safe_load((INFRA / "compose" / "compose.yaml").read_text())
SERVICES = COMPOSE["services"]


def options_of_serve():
    app = typer.Typer()
    add_to(app)
    app.callback()(lambda: None)
    command = typer.main.get_command(app).commands["serve"]
    return {option for parameter in command.params for option in parameter.opts}


def test_compose_services_name_each_other_and_their_volumes_rightly():
    for name, service in SERVICES.items():
        needed = service.get("depends_on", {})
        assert set(needed) <= set(SERVICES), name
        for other in needed if isinstance(needed, dict) else ():
            if needed[other]["condition"] == "service_healthy":
                assert "healthcheck" in SERVICES[other], other
        for volume in service.get("volumes", ()):
            source = volume.split(":")[0]
            if source.startswith("."):
                path = (INFRA / "compose" / source).resolve()
                assert path.exists() or path.name == "inbox", volume
            else:
                assert source in COMPOSE["volumes"], volume


def test_compose_opens_its_ports_to_this_machine_alone_and_holds_no_secret():
    ports = [port for service in SERVICES.values() for port in service.get("ports", ())]
    assert ports
    assert all(port.startswith("127.0.0.1:") for port in ports)
    given = [pair for each in SERVICES.values() for pair in each.get("environment", {}).items()]
    secret = [value for name, value in given if re.search("PASSWORD|SECRET|TOKEN", name)]
    assert len(secret) >= 5
    assert all(re.fullmatch(r"\$\{\w+:\?\}", value) for value in secret), secret


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


def test_prometheus_scrapes_services_that_are_there():
    scraped = yaml.safe_load((INFRA / "prometheus" / "prometheus.yml").read_text())
    for job in scraped["scrape_configs"]:
        for target in job["static_configs"][0]["targets"]:
            host, _, port = target.partition(":")
            text = str(SERVICES[host])
            assert port in text, target
    (rules,) = yaml.safe_load((INFRA / "prometheus" / "alerts.yml").read_text())["groups"]
    assert all({"alert", "expr", "annotations"} <= set(rule) for rule in rules["rules"])
    # The figures' server answers to the name under which it is scraped.
    assert "--host-name=serve" in SERVICES["serve"]["command"]


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
    """A mark: set-ups are looked at by their own tools where these are installed."""
    return pytest.mark.skipif(shutil.which(tool) is None, reason=f"{tool} is not installed")


@needs("kubectl")
def test_kubectl_builds_the_kubernetes_set_up():
    built = subprocess.run(
        ["kubectl", "kustomize", INFRA / "kubernetes"], capture_output=True, text=True, check=True
    )
    documents = list(yaml.safe_load_all(built.stdout))
    assert {each["metadata"]["namespace"] for each in documents} == {"worldpose"}
    assert "image: worldpose\n" not in built.stdout
    assert len(documents) == len(manifests()) + 1  # the settings that are made of literals


@needs("kubernetes-validate")
@pytest.mark.parametrize("version", ["1.28", "1.37"])
def test_the_kubernetes_set_up_is_as_the_api_has_it(version):
    files = sorted(set((INFRA / "kubernetes").glob("*.yaml")) - {KUSTOMIZATION})
    command = ["kubernetes-validate", "--strict", "-k", version, *files]
    said = subprocess.run(command, capture_output=True, text=True)
    lines = (said.stdout + said.stderr).splitlines()
    # It ends with 0 whatever it finds.
    assert [line for line in lines if "passed for resource" not in line] == []
    assert len(lines) == len(manifests())


@needs("docker-compose")
def test_compose_takes_its_set_up_and_refuses_one_without_secrets():
    tool = shutil.which("docker-compose")
    command = [tool, "-f", INFRA / "compose" / "compose.yaml", "--profile", "gpu"]
    secrets = ["WORLDPOSE_REVIEW_TOKEN", "POSTGRES_PASSWORD", "S3_SECRET", "GRAFANA_PASSWORD"]
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
    for kind, name in (("config", "prometheus.yml"), ("rules", "alerts.yml")):
        subprocess.run(["promtool", "check", kind, INFRA / "prometheus" / name], check=True)


def test_the_batch_script_is_a_shell_script_that_asks_for_its_arguments():
    script = INFRA / "slurm" / "dask.sbatch"
    subprocess.run(["bash", "-n", script], check=True)
    bare = subprocess.run(["bash", script], capture_output=True, text=True, env={"PATH": "/bin"})
    assert bare.returncode != 0
    assert "a match folder" in bare.stderr
    directives = re.findall(r"^#SBATCH (--[\w-]+)", script.read_text(), re.MULTILINE)
    assert {"--nodes", "--time", "--requeue"} <= set(directives)


def test_the_image_is_made_of_what_is_there():
    text = (INFRA / "container" / "Containerfile").read_text()
    for sources in re.findall(r"^COPY (.+) \S+$", text, re.MULTILINE):
        for source in sources.split():
            assert (INFRA.parent / source).exists(), source
    ignored = (INFRA / "container" / "Containerfile.ignore").read_text()
    for source in re.findall(r"^COPY (\w+) \w+$", text, re.MULTILINE):
        assert f"!{source}\n" in ignored
