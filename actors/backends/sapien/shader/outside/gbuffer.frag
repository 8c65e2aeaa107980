#version 450
// The picture from outside: what the sun does not see lies in shadow.

#include "../common/surface.glsl"

struct LightBuffer {
  mat4 viewMatrix;
  mat4 viewMatrixInverse;
  mat4 projectionMatrix;
  mat4 projectionMatrixInverse;
  int width;
  int height;
};

layout(set = 3, binding = 1) uniform ShadowBuffer {
  LightBuffer pointLightBuffers[60];
  LightBuffer directionalLightBuffers[3];
  LightBuffer spotLightBuffers[10];
  LightBuffer texturedLightBuffers[1];
} shadows;

layout(set = 3, binding = 2) uniform samplerCube samplerPointLightDepths[10];
layout(set = 3, binding = 3) uniform sampler2D samplerDirectionalLightDepths[3];
layout(set = 3, binding = 4) uniform sampler2D samplerSpotLightDepths[10];
layout(set = 3, binding = 5) uniform sampler2D samplerTexturedLightDepths[1];
layout(set = 3, binding = 6) uniform sampler2D samplerTexturedLightTextures[1];
layout(set = 3, binding = 7) uniform samplerCube samplerEnvironment;
layout(set = 3, binding = 8) uniform sampler2D samplerBRDFLUT;

layout(location = 0) in vec3 worldNormal;
layout(location = 1) in vec2 textureUV;
layout(location = 2) in vec3 worldPosition;
layout(location = 0) out vec4 outColor;

const float LIFT_M = 0.003;  // so that a surface does not shade itself
const int REACH = 1;         // texels around the place that soften the edge of a shadow

// Share of the sun's light that arrives at a place; all of it outside the shadow map.
float sunShare(vec3 place) {
  mat4 toMap = shadows.directionalLightBuffers[0].projectionMatrix *
               shadows.directionalLightBuffers[0].viewMatrix;
  vec4 seen = toMap * vec4(place, 1.0);
  vec2 uv = 0.5 + 0.5 * seen.xy;
  if (any(lessThan(uv, vec2(0.0))) || any(greaterThan(uv, vec2(1.0)))) return 1.0;
  vec2 texel = 1.0 / vec2(textureSize(samplerDirectionalLightDepths[0], 0));
  float lit = 0.0;
  for (int x = -REACH; x <= REACH; ++x)
    for (int y = -REACH; y <= REACH; ++y)
      lit += step(seen.z, texture(samplerDirectionalLightDepths[0], uv + texel * vec2(x, y)).x);
  return lit / float((2 * REACH + 1) * (2 * REACH + 1));
}

void main() {
  if (isScreen()) {
    outColor = screenColor(textureUV);
    return;
  }
  vec3 normal = normalize(worldNormal);
  float share = sunShare(worldPosition + LIFT_M * normal);
  outColor = litColor(skylight(normal) + share * sunlight(normal));
}
