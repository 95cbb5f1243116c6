{{- define "placewise.name" -}}
{{ .Values.nameOverride | default .Release.Name | trunc 40 | trimSuffix "-" }}
{{- end }}

{{/* Labels that select the pods of a component. Takes a dict of root and component. */}}
{{- define "placewise.selector" -}}
app.kubernetes.io/name: placewise
app.kubernetes.io/instance: {{ .root.Release.Name }}
app.kubernetes.io/component: {{ .component }}
{{- end }}

{{- define "placewise.labels" -}}
{{ include "placewise.selector" . }}
app.kubernetes.io/part-of: placewise
app.kubernetes.io/version: {{ .root.Chart.AppVersion | quote }}
app.kubernetes.io/managed-by: {{ .root.Release.Service }}
helm.sh/chart: {{ .root.Chart.Name }}-{{ .root.Chart.Version }}
{{- end }}

{{/* Metadata of a pod template. A changed setting replaces the pods. */}}
{{- define "placewise.podMetadata" -}}
labels:
  {{- include "placewise.selector" . | nindent 2 }}
  app.kubernetes.io/part-of: placewise
annotations:
  checksum/settings: {{ include "placewise.settings" .root | sha256sum }}
{{- end }}

{{/* The settings that all services share. SEARCH_URLS lists every worker that may exist; missing ones are skipped. */}}
{{- define "placewise.settings" -}}
{{- $name := include "placewise.name" . }}
{{- $urls := list }}
{{- range $replica := until (int .Values.search.replicas.max) }}
{{- $urls = append $urls (printf "http://%s-search-%d.%s-search:8000" $name $replica $name) }}
{{- end }}
{{- $fixed := dict "HOST" "0.0.0.0" "PORT" "8000" "METRICS_PORT" "9100" "SEARCH_URLS" (join "," $urls) }}
{{- range $setting, $value := merge $fixed .Values.settings }}
{{- /* Helm reads numbers as floats: toString would write 2.5e+08. */}}
{{ $setting }}: {{ ternary $value ($value | toJson) (kindIs "string" $value) | quote }}
{{- end }}
{{- end }}

{{/* What every pod has in common: no privileges. Takes root and component; values of the component in `values`. */}}
{{- define "placewise.podSpec" -}}
automountServiceAccountToken: false
enableServiceLinks: false
securityContext:
  runAsNonRoot: true
  runAsUser: 10001
  runAsGroup: 10001
  fsGroup: 10001
  seccompProfile: {type: RuntimeDefault}
{{- with .root.Values.image.pullSecrets }}
imagePullSecrets: {{ toJson . }}
{{- end }}
{{- with .values.nodeSelector }}
nodeSelector: {{ toJson . }}
{{- end }}
{{- with .values.tolerations }}
tolerations: {{ toJson . }}
{{- end }}
{{- end }}

{{- define "placewise.spread" -}}
topologySpreadConstraints:
  {{- range .root.Values.topologyKeys }}
  - maxSkew: 1
    topologyKey: {{ . }}
    whenUnsatisfiable: ScheduleAnyway
    labelSelector:
      matchLabels:
        {{- include "placewise.selector" $ | nindent 8 }}
  {{- end }}
{{- end }}

{{/* What every container has in common: settings, its secrets, a read-only file system. Takes root, image, args, secrets, values, and in addition env, mounts and keys: variables of commands, which read no files, by the Secret's entries. */}}
{{- define "placewise.container" -}}
- name: placewise
  image: {{ .root.Values.image.prefix }}placewise-{{ .image }}:{{ .root.Values.image.tag | default .root.Chart.AppVersion }}{{ .imageSuffix }}
  imagePullPolicy: {{ .root.Values.image.pullPolicy }}
  args: {{ toJson .args }}
  envFrom:
    - configMapRef: {name: {{ include "placewise.name" .root }}}
  env:
    {{- range $name, $value := .env }}
    - {name: {{ $name }}, value: {{ $value | quote }}}
    {{- end }}
    {{- range .secrets }}
    {{- if $.root.Values.secrets.asFiles }}
    - {name: {{ . }}_FILE, value: /run/secrets/placewise/{{ . }}}
    {{- else }}
    - name: {{ . }}
      valueFrom: {secretKeyRef: {name: {{ $.root.Values.secrets.existingSecret }}, key: {{ . }}}}
    {{- end }}
    {{- end }}
    {{- range $name, $key := .keys }}
    - name: {{ $name }}
      valueFrom: {secretKeyRef: {name: {{ $.root.Values.secrets.existingSecret }}, key: {{ $key }}}}
    {{- end }}
  securityContext:
    allowPrivilegeEscalation: false
    readOnlyRootFilesystem: true
    capabilities: {drop: [ALL]}
  resources: {{ toJson (.resources | default .values.resources) }}
  volumeMounts:
    - {name: tmp, mountPath: /tmp}
    {{- range $name, $path := .mounts }}
    - {name: {{ $name }}, mountPath: {{ $path }}}
    {{- end }}
    {{- if .root.Values.secrets.asFiles }}
    - {name: secrets, mountPath: /run/secrets/placewise, readOnly: true}
    {{- end }}
{{- end }}

{{- define "placewise.volumes" -}}
- name: tmp
  emptyDir: {sizeLimit: 1Gi}
{{- if .root.Values.secrets.asFiles }}
- name: secrets
  secret:
    secretName: {{ .root.Values.secrets.existingSecret }}
    items:
      {{- range .secrets }}
      - {key: {{ . }}, path: {{ . }}}
      {{- end }}
{{- end }}
{{- end }}

{{/* Probes of a service with an HTTP API, which leaves its Service before it stops. */}}
{{- define "placewise.httpProbes" -}}
ports: [{name: http, containerPort: 8000}]
startupProbe:
  httpGet: {path: /livez, port: http}
  periodSeconds: 2
  failureThreshold: 60
livenessProbe:
  httpGet: {path: /livez, port: http}
  periodSeconds: 10
  timeoutSeconds: 5
  failureThreshold: 6
readinessProbe:
  httpGet: {path: /readyz, port: http}
  periodSeconds: 5
  timeoutSeconds: 5
lifecycle:
  preStop: {exec: {command: [sleep, "8"]}}
{{- end }}

{{/* Probes of a service without one: it touches a file, which may be `seconds` old. Takes seconds and, for the start, startPeriod and startFailures. */}}
{{- define "placewise.heartbeatProbes" -}}
startupProbe:
  exec: {command: [python, -m, shared.telemetry.heartbeat, /tmp/heartbeat, "{{ .seconds }}"]}
  periodSeconds: {{ .startPeriod }}
  timeoutSeconds: 5
  failureThreshold: {{ .startFailures }}
livenessProbe:
  exec: {command: [python, -m, shared.telemetry.heartbeat, /tmp/heartbeat, "{{ .seconds }}"]}
  periodSeconds: 30
  timeoutSeconds: 5
  failureThreshold: 3
{{- end }}

{{/* One pod of a component may be evicted at a time. */}}
{{- define "placewise.disruptionBudget" -}}
apiVersion: policy/v1
kind: PodDisruptionBudget
metadata:
  name: {{ .name }}
  labels:
    {{- include "placewise.labels" . | nindent 4 }}
spec:
  maxUnavailable: 1
  selector:
    matchLabels:
      {{- include "placewise.selector" . | nindent 6 }}
{{- end }}
