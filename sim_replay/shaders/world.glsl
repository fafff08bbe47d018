// Sky, clouds, hills and ground along a ray, shared by every program that draws surroundings.
// A software driver runs both sides of every branch, so what a picture lacks is left out by SKY, GROUND (its kind),
// HILLS, VEIL, NEAR_CLOUD and LENS.
uniform sampler2D noise;
uniform vec4 environment[11];
uniform vec4 K;                // fx, fy, cx, cy
uniform vec4 lens;             // k1, k2, p1, p2
uniform vec2 lens_end;         // k3, squared radius where the model would fold
uniform mat3 ned_from_cam;
uniform vec3 camera_ned_m;

const mat2 turn = mat2(0.80, 0.60, -0.60, 0.80);
const float HILLS_M = 14000.0, HAZE_LAYER_M = 700.0;

// The unit ray of a pixel, NED; the lens is undone by fixed-point iteration as in OpenCV's undistortPoints.
vec3 ray_ned(vec2 pixel) {
    vec2 seen = (pixel - K.zw) / K.xy;
    vec2 p = seen;
#ifdef LENS
    for (int k = 0; k < 12; ++k) {
        float r2 = min(dot(p, p), lens_end.y);
        float radial = 1.0 + r2 * (lens.x + r2 * (lens.y + r2 * lens_end.x));
        p = (seen - 2.0 * p.x * p.y * lens.zw - lens.wz * (r2 + 2.0 * p * p)) / radial;
    }
#endif
    return normalize(ned_from_cam * vec3(p, 1.0));
}

vec3 veil(vec3 d) {
#ifdef VEIL
    float s = max(dot(d, environment[0].xyz), 0.0);
    return environment[1].rgb * environment[9].x * (0.25 + 0.5 * pow(s, 8.0) + 1.2 * pow(s, 120.0));
#else
    return vec3(0.0);
#endif
}

// What haze tends to: warmer on the sun's side of a low sun.
vec3 horizon(vec3 d) {
    vec2 sun = environment[0].xy;
    float towards = 0.5 + 0.5 * dot(d.xy, sun) / (length(d.xy) * length(sun) + 1e-3);
    return mix(environment[10].rgb, environment[3].rgb, towards * towards);
}

vec3 sky(vec3 d) {
    float up = max(-d.z, 0.0);
    vec3 low = horizon(d);
    vec3 c = mix(environment[2].rgb, low, pow(1.0 - up, 4.0));
    float s = max(dot(d, environment[0].xyz), 0.0);
    c += environment[1].rgb * environment[8].w * (0.35 * pow(s, 6.0) + 0.5 * pow(s, 60.0));
    float fade = smoothstep(0.015, 0.12, up);
    vec2 plane = d.xy / max(up, 0.015);
    vec2 high = (camera_ned_m.xy + plane * 9000.0) / 40000.0 + environment[8].xy;
    float cirrus = smoothstep(0.4, 0.8, texture(noise, high * vec2(1.0, 2.7)).g) * environment[4].a;
    c = mix(c, environment[4].rgb * 1.1, cirrus * fade);
    vec2 p = (camera_ned_m.xy + plane * (environment[2].a + camera_ned_m.z)) / environment[8].z + environment[8].xy;
    // Octaves turned against each other, and a slow swell, so that the texture's period does not show.
    vec2 p3 = turn * p * 3.3;
    float swell = texture(noise, turn * p * 0.173).g;
    float n = 0.30 * swell + 0.32 * texture(noise, p).r + 0.23 * texture(noise, p3).r
        + 0.15 * texture(noise, turn * p3 * 3.5).b;
    float shade = 0.6 * (n - 0.30 * swell - 0.32 * texture(noise, p + 0.02 * environment[0].xy).r - 0.18);
    float a = smoothstep(environment[0].a, environment[0].a + environment[1].a, n) * fade;
    vec3 cloud = environment[4].rgb * clamp(1.0 + 1.6 * shade - 0.35 * a * (n - environment[0].a), 0.45, 1.3);
    c = mix(c, mix(cloud, low, 0.6 * (1.0 - smoothstep(0.0, 0.4, up))), a);
    c = mix(low, c, exp(-HAZE_LAYER_M * environment[3].a / (up + 0.03)));
    return c + environment[1].rgb * environment[8].w * (1.0 - 0.9 * a) * 4.0 * pow(s, 20000.0);
}

// Two ridges of hills over whatever sky stands behind them.
vec3 hills(vec3 d, vec3 behind) {
    float up = -d.z / length(d.xy), steepest = environment[9].y / HILLS_M;
    if (up > steepest) return behind;
    float azimuth = atan(d.y, d.x) * 0.318309886;
    vec3 c = behind;
    for (int k = 1; k >= 0; --k) {
        float at = azimuth + 0.37 * float(k) + environment[8].x;
        float n = 0.7 * texture(noise, vec2(3.0 * at, 0.13)).r + 0.25 * texture(noise, vec2(17.0 * at, 0.57)).r
            + 0.05 * texture(noise, vec2(90.0 * at, 0.81)).b;
        float ridge = steepest * (k == 1 ? 1.0 : 0.6) * smoothstep(0.2, 0.9, n);
        float away = HILLS_M * (k == 1 ? 2.0 : 1.0);
        vec3 slope = environment[6].rgb * (0.55 + 0.5 * texture(noise, vec2(40.0 * at, up * 60.0)).b);
        float clear = exp(-0.6 * away * environment[3].a) * mix(0.4, 1.0, clamp(up / max(ridge, 1e-4), 0.0, 1.0));
        vec3 hazed = mix(horizon(d), slope, clear);
        c = mix(c, hazed, smoothstep(-0.7, 0.7, (ridge - up) * K.y));
    }
    return c;
}

float cell(vec2 i) { return fract(sin(dot(i, vec2(12.9898, 78.233))) * 43758.5453); }

vec3 fields(vec2 g, float wide, float near, float pixel_m) {
    vec2 q = g / environment[6].a * vec2(1.0, 0.55) + 1.2 * (wide - 0.5);
    float kind = cell(floor(q)), soft = clamp(2.0 * pixel_m / environment[6].a, 0.01, 0.3);
    vec2 edge = abs(fract(q) - 0.5);
    vec3 c = mix(environment[5].rgb, environment[6].rgb, kind) * (0.75 + 0.5 * cell(floor(q) + 7.0));
    vec2 along = kind < 0.5 ? vec2(0.9, 0.02) : vec2(0.02, 0.9);
    c *= 0.92 + 0.16 * texture(noise, along * g / 40.0).b;
    c = mix(c, environment[7].rgb, smoothstep(0.48 - soft, 0.48 + soft, max(edge.x, edge.y)) * (1.0 - soft));
    return mix(c, environment[7].rgb, smoothstep(0.58, 0.62, near));
}

vec3 town(vec2 g, float wide, float near, float pixel_m) {
    float block_m = 0.4 * environment[6].a;
    vec2 q = g / block_m * vec2(1.0, 0.7), house = g / 17.0;
    vec2 edge = abs(fract(q) - 0.5);
    float detail = clamp(1.6 - pixel_m / 6.0, 0.0, 1.0);
    float roof = mix(0.5, cell(floor(house)), detail);
    vec3 c = mix(environment[5].rgb, environment[6].rgb, roof) * (0.6 + 0.9 * mix(0.5, cell(floor(house) + 3.0), detail));
    float garden = smoothstep(0.45, 0.55, near) * 0.8;
    vec2 gap = abs(fract(house) - 0.5);
    c = mix(c, environment[7].rgb, max(garden, 0.8 * detail * smoothstep(0.3, 0.38, max(gap.x, gap.y))));
    float soft = clamp(2.0 * pixel_m / block_m, 0.01, 0.3);
    float road = smoothstep(0.45 - soft, 0.45 + soft, max(edge.x, edge.y)) * (1.0 - soft);
    c = mix(c, environment[6].rgb * 0.8, road);
    vec3 country = mix(environment[7].rgb, environment[6].rgb * 0.7, near);
    return mix(c, country, smoothstep(0.5, 0.56, wide));
}

vec3 sea(vec3 d, float near, float fine) {
    vec3 normal = normalize(vec3(0.25 * (near - 0.5), 0.25 * (fine - 0.5), -1.0));
    vec3 mirrored = reflect(d, normal);
    float fresnel = 0.03 + 0.97 * pow(1.0 - clamp(dot(-d, normal), 0.0, 1.0), 5.0);
    vec3 above = mix(horizon(mirrored), environment[2].rgb, clamp(-mirrored.z, 0.0, 1.0));
    float glint = pow(max(dot(mirrored, environment[0].xyz), 0.0), 180.0);
    vec3 c = mix(environment[5].rgb, above, fresnel) + environment[1].rgb * glint * 1.5;
    return mix(c, environment[7].rgb, 0.4 * smoothstep(0.68, 0.8, fine));
}

#ifdef GROUND
vec3 ground(vec3 d) {
    float range_m = -camera_ned_m.z / max(d.z, 1e-4);
    float pixel_m = range_m / K.y / max(sqrt(d.z), 0.05);
    vec2 g = camera_ned_m.xy + d.xy * range_m;
    float a = environment[7].a;
    g = mat2(cos(a), sin(a), -sin(a), cos(a)) * g;
    float wide = texture(noise, g / 9000.0 + environment[8].xy).r;
    float near = 0.5 + 0.7 * (texture(noise, g / 700.0).r + texture(noise, turn * g / 1130.0).g - 1.0);
    // Sharper than the hardware would have it: seen aslant, it would blur along both axes.
    vec2 bent = g + 160.0 * vec2(wide, near);
    float fine = texture(noise, bent / 290.0, -1.0).b, grain = texture(noise, turn * bent / 71.0, -1.0).b;
#if GROUND == 0
    vec3 c = fields(g, wide, near, pixel_m);
#elif GROUND == 3
    vec3 c = sea(d, near, fine);
#elif GROUND == 4
    vec3 c = town(g, wide, near, pixel_m);
#else
    vec3 c = mix(environment[5].rgb, environment[6].rgb, smoothstep(0.3, 0.7, near));
    c = mix(c, environment[7].rgb, smoothstep(0.55, 0.7, GROUND == 5 ? 0.5 * (wide + near) : wide));
#endif
#if GROUND != 3
    // Trees stand dark and in clumps; what lies between them is worn and mown.
    float wooded = smoothstep(0.56, 0.62, mix(grain, near, GROUND == 1 ? 0.15 : 0.6));
    c *= GROUND == 2 ? 1.0 : 1.0 - 0.45 * wooded;
    float rough = GROUND == 1 ? 1.8 : 0.9;
    c *= max(1.0 + rough * (0.35 * fine + 0.35 * grain + 0.3 * near - 0.5), 0.2);
#else
    c *= 0.75 + 0.5 * fine;
#endif
    return mix(horizon(d), c, exp(-range_m * environment[3].a));
}
#endif

// Share of the light that shreds of cloud just ahead of the camera take; they drift past as it flies.
float near_cloud(vec3 d) {
#ifdef NEAR_CLOUD
    // Shreds about as large in the picture as what they hide, whatever the lens.
    vec2 at = vec2(atan(d.y, d.x), -d.z) * (K.x / 900.0) + (camera_ned_m.xy + camera_ned_m.z) / 900.0 + environment[8].yx;
    float n = 0.55 * texture(noise, at).r + 0.3 * texture(noise, turn * at * 3.1).g + 0.15 * texture(noise, at * 9.7).b;
    float open = 0.75 - 0.5 * environment[9].z;
    return 0.95 * smoothstep(open, open + 0.22, n);
#else
    return 0.0;
#endif
}

vec3 near_cloud_colour() { return mix(environment[4].rgb, environment[3].rgb, 0.5); }

// What stands at the end of the ray, `sky_there` where that is the sky.
vec3 surroundings(vec3 d, vec3 sky_there) {
#ifdef HILLS
    sky_there = hills(d, sky_there);
#endif
#if defined(GROUND) && defined(SKY)
    return d.z > 0.0 ? ground(d) : sky_there;
#elif defined(GROUND)
    return ground(d);
#else
    return sky_there;
#endif
}
