{{/* The name of a part: RELEASE-router, RELEASE-recorder. */}}
{{- define "zbridge.name" -}}
{{- printf "%s-%s" (.root.Release.Name | trunc 30 | trimSuffix "-") .part -}}
{{- end -}}

{{/* The name of a robot's objects. Names that are invalid in Kubernetes get part of their hash. */}}
{{- define "zbridge.robot" -}}
{{- $plain := regexReplaceAll "[^a-z0-9]+" (lower .robot) "-" | trimAll "-" -}}
{{- if or (ne $plain .robot) (gt (len $plain) 24) -}}
{{- $plain = printf "%s-%s" (trunc 17 $plain | trimSuffix "-") (sha256sum .robot | trunc 6) | trimPrefix "-" -}}
{{- end -}}
{{- include "zbridge.name" (dict "root" .root "part" (printf "robot-%s" $plain) ) -}}
{{- end -}}

{{- define "zbridge.selector" -}}
app.kubernetes.io/name: zbridge
app.kubernetes.io/instance: {{ .root.Release.Name }}
app.kubernetes.io/component: {{ .component }}
{{- end -}}

{{- define "zbridge.labels" -}}
{{ include "zbridge.selector" . }}
app.kubernetes.io/version: {{ .root.Chart.AppVersion | quote }}
app.kubernetes.io/managed-by: {{ .root.Release.Service }}
helm.sh/chart: {{ printf "%s-%s" .root.Chart.Name .root.Chart.Version }}
{{- end -}}

{{- define "zbridge.image" -}}
{{ printf "%s:%s" .Values.image.repository (.Values.image.tag | default .Chart.AppVersion) }}
{{- end -}}

{{/* Every pod: no permission that it does not need, no token of the cluster. */}}
{{- define "zbridge.pod" -}}
automountServiceAccountToken: false
enableServiceLinks: false
terminationGracePeriodSeconds: 10
{{- with .Values.image.pullSecrets }}
imagePullSecrets:
  {{- range . }}
  - name: {{ . }}
  {{- end }}
{{- end }}
securityContext:
  runAsNonRoot: true
  runAsUser: 10001
  runAsGroup: 10001
  fsGroup: 10001
  fsGroupChangePolicy: OnRootMismatch
  seccompProfile: {type: RuntimeDefault}
{{- end -}}

{{- define "zbridge.container" -}}
image: {{ include "zbridge.image" . }}
imagePullPolicy: {{ .Values.image.pullPolicy }}
securityContext:
  allowPrivilegeEscalation: false
  readOnlyRootFilesystem: true
  capabilities: {drop: [ALL]}
{{- end -}}

{{- define "zbridge.placement" -}}
{{- with .nodeSelector }}
nodeSelector: {{- toYaml . | nindent 2 }}
{{- end }}
{{- with .tolerations }}
tolerations: {{- toYaml . | nindent 2 }}
{{- end }}
{{- end -}}

{{- define "zbridge.bus" -}}
{{- if .Values.bus.connect -}}
{{- toJson .Values.bus.connect -}}
{{- else if .Values.router.enabled -}}
{{- list (printf "tls/%s:7447" (include "zbridge.name" (dict "root" . "part" "router"))) | toJson -}}
{{- else -}}
{{- fail "bus.connect: missing; it is required if router.enabled is false" -}}
{{- end -}}
{{- end -}}

{{- define "zbridge.dns" -}}
- ports:
    - {port: 53, protocol: UDP}
    - {port: 53, protocol: TCP}
{{- end -}}

{{/* An egress rule to the routers of the bus. */}}
{{- define "zbridge.toBus" }}
{{- if .Values.bus.connect }}
{{- range .Values.networkPolicy.routerTo }}
- to: [{ipBlock: {cidr: {{ . | quote }}}}]
{{- end }}
{{- else }}
- to:
    - podSelector:
        matchLabels: {{- include "zbridge.selector" (dict "root" . "component" "router") | nindent 10 }}
  ports: [{port: 7447, protocol: TCP}]
{{- end }}
{{- end -}}

{{/* A value in TOML. Integers stay integers, unlike with toToml of YAML values. */}}
{{- define "zbridge.value" -}}
{{- if kindIs "map" . -}}
{{- $parts := list -}}
{{- range $key, $value := . -}}
{{- if not (kindIs "invalid" $value) -}}{{- $parts = append $parts (printf "%s = %s" (toJson $key) (include "zbridge.value" $value)) -}}{{- end -}}
{{- end -}}
{ {{- join ", " $parts -}} }
{{- else if kindIs "slice" . -}}
{{- $parts := list -}}
{{- range . -}}{{- $parts = append $parts (include "zbridge.value" .) -}}{{- end -}}
[{{- join ", " $parts -}}]
{{- else -}}
{{- toJson . -}}
{{- end -}}
{{- end -}}

{{/* A file in TOML: first the plain keys, then the tables. */}}
{{- define "zbridge.toml" -}}
{{- range $key, $value := . -}}
{{- if not (kindIs "map" $value) }}
{{ $key }} = {{ include "zbridge.value" $value }}
{{- end -}}
{{- end -}}
{{- range $table, $keys := . -}}
{{- if kindIs "map" $keys }}

[{{ $table }}]
{{- range $key, $value := $keys }}
{{- if not (kindIs "invalid" $value) }}
{{ toJson $key }} = {{ include "zbridge.value" $value }}
{{- end }}
{{- end }}
{{- end -}}
{{- end -}}
{{- end -}}
