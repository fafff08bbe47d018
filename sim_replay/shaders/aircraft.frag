#version 330 core
// Sun with its shadows, sky and ground light on paint, glass and metal, then haze. Gamma 2 in eight bits.
uniform sampler2D noise;
uniform sampler2DShadow shadows;
uniform vec4 environment[11];
uniform vec4 livery[19];       // 0-15 palette and gloss; 16 camouflage, share; 17 marking, tip; 18 band x, width, offset
uniform mat3 ned_from_body;
uniform vec3 camera_body_m;
uniform vec4 extent;           // 1/diameter, half span m, length m, target number
uniform ivec2 corner;          // of this crop in the supersampled buffer
uniform float shadowed;        // 1: the shadow atlas holds this aircraft
in vec3 body_m;
in vec3 normal_body;
in vec3 shadow_at;
flat in int part;
layout(location = 0) out vec4 colour;
layout(location = 1) out vec4 coordinate;

const int WING = 1, TAIL = 2, GLASS = 3, METAL = 4, TYRE = 6, PROPELLER_DISC = 7;

vec3 paint() {
    vec3 albedo = livery[part].rgb;
    if (part > TAIL) return albedo;
    vec2 skin = vec2(body_m.x, part == WING ? body_m.y : body_m.y + body_m.z) / extent.z;
    float grain = texture(noise, skin * 0.9 + livery[18].zw).r;
    if (livery[16].a > 0.0 && grain > 1.0 - livery[16].a) albedo = livery[16].rgb;
    bool tip = part == WING && abs(body_m.y) > livery[17].a * extent.y;
    bool band = part != WING && abs(body_m.x / extent.z - livery[18].x) < livery[18].y;
    if (tip || band) albedo = livery[17].rgb;
    return albedo * (0.88 + 0.24 * texture(noise, skin * 3.0).b);
}

void main() {
    if (part == PROPELLER_DISC) {
        // Screen-door: a turning propeller leaves about an eighth of its disc, less than half of any pixel.
        float hash = fract(52.9829189 * fract(dot(floor(gl_FragCoord.xy) - vec2(corner), vec2(0.06711056, 0.00583715))));
        if (hash > 0.13) discard;
    }
    vec3 to_camera = camera_body_m - body_m;
    float range_m = length(to_camera);
    vec3 view = ned_from_body * (to_camera / range_m);
    vec3 n = normalize(ned_from_body * normal_body);
    if (dot(n, view) < 0.0) n = -n;
    vec3 sun = environment[0].xyz;
    float direct = max(dot(n, sun), 0.0);
    if (shadowed > 0.5 && direct > 0.0) direct *= texture(shadows, shadow_at);
    vec3 sky = 0.5 * (environment[3].rgb + environment[2].rgb);
    vec3 ground = 0.85 * environment[5].rgb + 0.1 * environment[3].rgb;
    float rough = part == GLASS ? 0.12 : part == METAL ? 0.35 : part == TYRE ? 0.9 : mix(0.65, 0.22, livery[0].a);
    // A belly sees less of the sky than a plate would: the aircraft's own parts stand in the way.
    vec3 light = environment[1].rgb * direct + mix(ground, sky, 0.5 - 0.5 * n.z) * (0.9 - 0.15 * max(n.z, 0.0));
    float facing = max(dot(n, view), 0.02);
    vec3 half_way = normalize(sun + view);
    float a2 = rough * rough * rough * rough;
    float d = dot(n, half_way) * dot(n, half_way) * (a2 - 1.0) + 1.0;
    float away = max(dot(sun, half_way), 0.1);
    float fresnel = 0.04 + 0.96 * pow(1.0 - away, 5.0);
    float highlight = min(a2 / (d * d) * fresnel * direct / (4.0 * away * away * (rough + 0.5)), 6.0);
    vec3 mirrored = reflect(-view, n);
    vec3 above = mix(environment[3].rgb, environment[2].rgb, sqrt(max(-mirrored.z, 0.0)));
    vec3 around = mix(above, ground, smoothstep(-0.15, 0.15, mirrored.z));
    float sheen = 0.04 + max(0.96 - rough, 0.0) * pow(1.0 - facing, 5.0);
    vec3 shaded = paint() * light * (1.0 - sheen) + sheen * around + environment[1].rgb * highlight;
    float towards = 0.5 - 0.5 * dot(view.xy, sun.xy) / (length(view.xy) * length(sun.xy) + 1e-3);
    vec3 haze = mix(environment[10].rgb, environment[3].rgb, towards * towards);
    shaded = mix(haze, shaded, exp(-range_m * environment[3].a));
    float s = max(dot(-view, sun), 0.0);
    shaded += environment[1].rgb * environment[9].x * (0.25 + 0.5 * pow(s, 8.0) + 1.2 * pow(s, 120.0));
    colour = vec4(sqrt(clamp(shaded, 0.0, 1.0)), 1.0);
    coordinate = vec4(body_m * extent.x, part == PROPELLER_DISC ? 0.0 : extent.w);
}
