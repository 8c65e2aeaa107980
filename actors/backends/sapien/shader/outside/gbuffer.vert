#version 450
// As for the eye, and with the place in the world, for shadows.

#include "../common/camera.glsl"
#include "../common/object.glsl"

layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
layout(location = 2) in vec2 uv;

layout(location = 0) out vec3 worldNormal;
layout(location = 1) out vec2 textureUV;
layout(location = 2) out vec3 worldPosition;

void main() {
  worldNormal = mat3(object.modelMatrix) * normal;
  textureUV = uv;
  vec4 place = object.modelMatrix * vec4(position, 1.0);
  worldPosition = place.xyz;
  gl_Position = camera.projectionMatrix * camera.viewMatrix * place;
}
