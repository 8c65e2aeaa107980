// Matt surfaces in the light of actors/backends/light.py.
// SAPIEN's own shaders take seconds to compile, and twice as long to draw.

layout(set = 2, binding = 0) uniform MaterialBuffer {
  vec4 emission;
  vec4 baseColor;
  float fresnel;
  float roughness;
  float metallic;
  float transmission;
  float ior;
  float transmissionRoughness;
  int textureMask;
  int padding;
  vec4 textureTransforms[6];
} material;

layout(set = 2, binding = 1) uniform sampler2D colorTexture;
layout(set = 2, binding = 2) uniform sampler2D roughnessTexture;
layout(set = 2, binding = 3) uniform sampler2D normalTexture;
layout(set = 2, binding = 4) uniform sampler2D metallicTexture;
layout(set = 2, binding = 5) uniform sampler2D emissionTexture;
layout(set = 2, binding = 6) uniform sampler2D transmissionTexture;

struct PointLight { vec4 position; vec4 emission; };
struct DirectionalLight { vec4 direction; vec4 emission; };
struct SpotLight { vec4 position; vec4 direction; vec4 emission; };

layout(set = 3, binding = 0) uniform SceneBuffer {
  vec4 ambientLight;
  PointLight pointLights[10];
  DirectionalLight directionalLights[3];
  SpotLight spotLights[10];
  SpotLight texturedLights[1];
} scene;

const vec3 TO_SUN = vec3(-0.26, -0.43, 0.865);
const float SUN = 0.4;
const float SKY = 0.55;
const float GROUND = 0.35;
const float GAMMA = 2.2;

const int HAS_EMISSION_TEXTURE = 16;  // bit of textureMask

bool isScreen() { return (material.textureMask & HAS_EMISSION_TEXTURE) != 0; }

// A screen glows by itself.
vec4 screenColor(vec2 uv) { return vec4(texture(emissionTexture, uv).rrr, 1.0); }

float skylight(vec3 normal) { return mix(GROUND, SKY, 0.5 + 0.5 * normal.z); }

float sunlight(vec3 normal) { return SUN * max(dot(normal, TO_SUN), 0.0); }

vec4 litColor(float light) {
  return vec4(pow(light * material.baseColor.rgb, vec3(1.0 / GAMMA)), 1.0);
}
